"""Fields that break what sphere tracing assumes: steep, saturated, clamped, thin, tiny, and around the camera."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from distrace.benchmarks.random_views import SENSOR_MM, RandomView, Shot, aim_at_surface, draw_shot
from distrace.camera import Camera
from distrace.fields import primitives
from distrace.fields.base import SDF, placed

CLAMP = 0.02  # radii: values of the clamped decoder end there
PLATE = 0.004  # radii: thickness of the thin plate
FREQUENCY = 30.0  # radians per radius, of the waves
AMPLITUDE = 0.06  # radii, of the waves
SATURATIONS = (1, 10, 15, 30)  # k of tanh(k f)
WIDTHS = (1, 2, 3)  # pixels
THICKEST = 0.4  # radii
TINY = (1e-3, 1e-2)  # radii, far below the cells of the default tracer
OF_DECODER = ("decoder × 2", "clamped")


class HardField(NamedTuple):
    """A field and its Lipschitz constant, by which the reference divides it."""

    sdf: SDF
    lipschitz: float


class Drawn(NamedTuple):
    """A field, its camera, and the field's Lipschitz constant."""

    sdf: SDF
    shot: Shot
    lipschitz: float = 1.0


Family = Callable[[np.random.Generator, Shot], Drawn]


def hard_fields(decoder: SDF, camera: Camera) -> Mapping[str, HardField]:
    """Returns five fields by name; `decoder` is a trained one, and the gap is as wide as one pixel of the camera."""
    like = camera.intrinsics
    pixel = float(2 * camera.tolerance(1.0).max() * camera.T_world_camera[:3, 3].norm())
    return {
        "decoder × 2": HardField(lambda points: 2 * decoder(points), 2.5),
        "thin plate": HardField(primitives.box(like.new_tensor([0.6, PLATE / 2, 0.4])), 1.0),
        "high frequencies": HardField(_waves(like), 1 + 2 * AMPLITUDE * FREQUENCY),
        "gap of a pixel": HardField(_gap(pixel, 0.3, like), 1.0),
        "clamped": HardField(lambda points: decoder(points).clamp(-CLAMP, CLAMP), 1.2),
    }


def analytic_views(decoder: SDF, count: int, sizes: tuple[int, int], seed: int) -> Iterator[RandomView]:
    """Draws `count` views of each family; `decoder` is a trained field for the families that distort one."""
    for name, family in families(decoder).items():
        random = np.random.default_rng(seed)
        for _ in range(count):
            drawn = family(random, draw_shot(random, sizes))
            yield RandomView(name, None, drawn.sdf, drawn.shot, drawn.lipschitz)


def families(decoder: SDF) -> Mapping[str, Family]:
    """Returns all families by name. A family draws a field, and moves the camera to where the field is hard."""
    solids = {"rod": _rod, "plate": _plate, "gap": _gap, "shell": _shell}
    return {
        **{f"tanh({k} f) of a table": partial(_saturated, k) for k in SATURATIONS},
        **{name: partial(_hard, decoder, name) for name in HARD},
        **{
            f"{name} of {n} px": partial(_thin, make, n, name == "gap") for name, make in solids.items() for n in WIDTHS
        },
        "tiny ball": partial(_tiny, primitives.sphere),
        "tiny box": partial(_tiny, lambda radius: primitives.box(torch.full((3,), radius / 3**0.5))),
        "camera in the sphere": _in_unit_sphere,
        "camera in the solid": _in_solid,
    }


def table() -> SDF:
    """Returns a table top 0.04 thick on four legs 0.024 thick."""
    legs = [
        primitives.capsule(torch.tensor([x, 0.3, z]), torch.tensor([x, -0.5, z]), 0.012)
        for x in (-0.5, 0.5)
        for z in (-0.3, 0.3)
    ]
    top = primitives.box(torch.tensor([0.6, 0.02, 0.4]))
    return primitives.union(lambda points: top(points - points.new_tensor([0, 0.3, 0])), *legs)


def _waves(like: Tensor) -> SDF:
    """Returns a sphere plus waves in random directions, as networks of sines have (Sitzmann et al., NeurIPS 2020)."""
    generator = torch.Generator().manual_seed(0)
    directions = normalize(torch.randn(16, 3, generator=generator), dim=-1).to(like) * FREQUENCY
    phases = (torch.rand(16, generator=generator) * 6.283).to(like)
    ball = primitives.sphere(0.6)
    return lambda points: ball(points) + AMPLITUDE * torch.sin(points @ directions.T + phases).mean(-1) * 2


def _saturated(k: float, random: np.random.Generator, shot: Shot) -> Drawn:
    solid = table()
    return Drawn(lambda points: torch.tanh(k * solid(points)), aim_at_surface(shot, solid, random), k)


def _hard(decoder: SDF, name: str, random: np.random.Generator, shot: Shot) -> Drawn:
    if name in OF_DECODER:
        shot = replace(shot, size=max(1, shot.size // 2))  # the reference takes longest on these families
    hard = hard_fields(decoder, shot.camera())[name]
    return Drawn(hard.sdf, aim_at_surface(shot, hard.sdf, random), hard.lipschitz)


def _thin(make: Callable[[float], SDF], pixels: int, through: bool, random: np.random.Generator, shot: Shot) -> Drawn:
    """Draws a solid `pixels` thick at a random place, in a random orientation or open to the line of sight."""
    middle = torch.from_numpy(random.uniform(-0.2, 0.2, 3)).float()
    pose = torch.eye(4)
    pose[:3, :3] = _rotation(random, _across(random, shot.eye() - middle) if through else None)
    pose[:3, 3] = middle
    sdf = placed(make(min(pixels * shot.pixel(middle), THICKEST)), pose)
    return Drawn(sdf, aim_at_surface(shot, sdf, random))


def _rod(width: float) -> SDF:
    return primitives.capsule(torch.tensor([-0.6, 0.0, 0.0]), torch.tensor([0.6, 0.0, 0.0]), width / 2)


def _plate(width: float) -> SDF:
    return primitives.box(torch.tensor([0.5, width / 2, 0.4]))


def _gap(width: float, half: float = 0.25, like: Tensor = torch.empty(0)) -> SDF:
    """Returns two boxes side by side along x, each `half` wide to either side of its middle."""
    box = primitives.box(like.new_tensor([half, 0.4, 0.3]))
    offset = like.new_tensor([half + width / 2, 0.0, 0.0])
    return primitives.union(lambda points: box(points - offset), lambda points: box(points + offset))


def _shell(width: float) -> SDF:
    """Returns a bowl: a hollow ball without its top."""
    ball = primitives.sphere(0.6)
    return primitives.intersection(
        lambda points: ball(points).abs() - width / 2, primitives.plane(torch.tensor([0.0, 1.0, 0.0]), 0.2)
    )


def _tiny(make: Callable[[float], SDF], random: np.random.Generator, shot: Shot) -> Drawn:
    """Draws a solid off centre, through a lens so long that it spans 0.3 to 0.9 of the image."""
    radius = float(np.exp(random.uniform(*np.log(TINY))))
    middle = torch.from_numpy(random.uniform(-0.5, 0.5, 3)).float()
    distance = float((shot.eye() - middle).norm())
    focal_mm = float(random.uniform(0.3, 0.9)) * SENSOR_MM * distance / (2 * radius)
    pose = torch.eye(4)
    pose[:3, :3] = _rotation(random)
    pose[:3, 3] = middle
    x, y, z = middle.tolist()
    return Drawn(placed(make(radius), pose), replace(shot, target=(x, y, z), focal_mm=focal_mm))


def _in_unit_sphere(random: np.random.Generator, shot: Shot) -> Drawn:
    """Draws a camera in front of a table, or among its legs."""
    solid = table()
    return Drawn(solid, aim_at_surface(replace(shot, distance=float(random.uniform(0.05, 0.95))), solid, random))


def _in_solid(random: np.random.Generator, shot: Shot) -> Drawn:
    """Draws a camera in a ball. Every ray starts in the solid and sees nothing."""
    return Drawn(primitives.sphere(0.5), replace(shot, distance=float(random.uniform(0.05, 0.45))))


def _across(random: np.random.Generator, sight: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Returns a direction at right angles to the line of sight, up to a few degrees."""
    across = torch.linalg.cross(sight, torch.from_numpy(random.normal(size=3)).float())
    return across / across.norm() + torch.from_numpy(random.normal(size=3)).float() * 0.03


def _rotation(random: np.random.Generator, x_axis: Float[Tensor, "3"] | None = None) -> Float[Tensor, "3 3"]:
    """Returns a random rotation; with an axis, one that maps x to plus or minus that axis."""
    columns = torch.from_numpy(random.normal(size=(3, 3)))
    if x_axis is not None:
        columns[:, 0] = x_axis
    rotation, _ = torch.linalg.qr(columns)
    rotation[:, 2] *= torch.linalg.det(rotation).sign()
    return rotation.float()


HARD = tuple(hard_fields(primitives.sphere(0.5), Camera.orbit(0, 0, 3, height=1, width=1)))
NAMES = tuple(families(primitives.sphere(0.5)))
