"""Analytic fields for random views: saturated, steep, one to three pixels thin, tiny, and seen from within.

Each family draws a field, and moves the camera to where the field is hard.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.benchmarks.hard_fields import hard_fields
from distrace.benchmarks.random_views import SENSOR_MM, Shot, View, aimed, draw_shot
from distrace.fields import primitives
from distrace.fields.base import SDF, placed

SATURATIONS = (1, 10, 15, 30)  # k of tanh(k f)
WIDTHS = (1, 2, 3)  # pixels
THICKEST = 0.4
TINY = (1e-3, 1e-2)  # radii, far below the cells of the default tracer
OF_DECODER = ("decoder × 2", "clamped")
HARD = ("decoder × 2", "thin plate", "high frequencies", "gap of a pixel", "clamped")


class Drawn(NamedTuple):
    """A field, a bound on its slope, and the camera that looks at it."""

    sdf: SDF
    shot: Shot
    steepest: float = 1.0


Family = Callable[[np.random.Generator, Shot], Drawn]


def analytic_views(decoder: SDF, count: int, sizes: tuple[int, int], seed: int) -> Iterator[View]:
    """Draws `count` views of each family; `decoder` is any well-trained field, for those that distort one."""
    for name, family in families(decoder).items():
        random = np.random.default_rng(seed)
        for _ in range(count):
            drawn = family(random, draw_shot(random, sizes))
            yield View(name, None, drawn.sdf, drawn.shot, drawn.steepest)


def families(decoder: SDF) -> Mapping[str, Family]:
    """All families by name."""
    thin = {"rod": _rod, "plate": _plate, "gap": _gap, "shell": _shell}
    return {
        **{f"tanh({k} f) of a table": partial(_saturated, k) for k in SATURATIONS},
        **{name: partial(_hard, decoder, name) for name in HARD},
        **{f"{name} of {n} px": partial(_thin, make, n, name == "gap") for name, make in thin.items() for n in WIDTHS},
        "tiny ball": partial(_tiny, primitives.sphere),
        "tiny box": partial(_tiny, lambda radius: primitives.box(torch.full((3,), radius / 3**0.5))),
        "camera in the sphere": _within_sphere,
        "camera in the solid": _within_solid,
    }


def table() -> SDF:
    """A table top 0.04 thick on four legs 0.024 thick."""
    legs = [
        primitives.capsule(torch.tensor([x, 0.3, z]), torch.tensor([x, -0.5, z]), 0.012)
        for x in (-0.5, 0.5)
        for z in (-0.3, 0.3)
    ]
    top = primitives.box(torch.tensor([0.6, 0.02, 0.4]))
    return primitives.union(lambda points: top(points - points.new_tensor([0, 0.3, 0])), *legs)


def _saturated(k: float, random: np.random.Generator, shot: Shot) -> Drawn:
    solid = table()
    return Drawn(lambda points: torch.tanh(k * solid(points)), aimed(shot, solid, random), k)


def _hard(decoder: SDF, name: str, random: np.random.Generator, shot: Shot) -> Drawn:
    if name in OF_DECODER:
        shot = replace(shot, size=max(1, shot.size // 2))  # of all families the reference is slowest with these
    hard = hard_fields(decoder, shot.camera())[name]
    return Drawn(hard.sdf, aimed(shot, hard.sdf, random), hard.steepest)


def _thin(make: Callable[[float], SDF], pixels: int, along: bool, random: np.random.Generator, shot: Shot) -> Drawn:
    """A solid at a random place whose thickness is so many pixels there; turned at random, or to be seen through."""
    middle = torch.from_numpy(random.uniform(-0.2, 0.2, 3)).float()
    pose = torch.eye(4)
    pose[:3, :3] = _turned(random, _across(random, shot.eye() - middle) if along else None)
    pose[:3, 3] = middle
    sdf = placed(make(min(pixels * shot.pixel(middle), THICKEST)), pose)
    return Drawn(sdf, aimed(shot, sdf, random))


def _rod(width: float) -> SDF:
    return primitives.capsule(torch.tensor([-0.6, 0.0, 0.0]), torch.tensor([0.6, 0.0, 0.0]), width / 2)


def _plate(width: float) -> SDF:
    return primitives.box(torch.tensor([0.5, width / 2, 0.4]))


def _gap(width: float) -> SDF:
    """Two boxes beside each other along x."""
    half, aside = primitives.box(torch.tensor([0.25, 0.4, 0.3])), torch.tensor([0.25 + width / 2, 0.0, 0.0])
    return primitives.union(lambda points: half(points - aside), lambda points: half(points + aside))


def _shell(width: float) -> SDF:
    """A bowl: a hollow ball without its top."""
    ball = primitives.sphere(0.6)
    return primitives.intersection(
        lambda points: ball(points).abs() - width / 2, primitives.plane(torch.tensor([0.0, 1.0, 0.0]), 0.2)
    )


def _tiny(make: Callable[[float], SDF], random: np.random.Generator, shot: Shot) -> Drawn:
    """A solid off centre, through a lens so long that it spans 0.3 to 0.9 of the image."""
    radius = float(np.exp(random.uniform(*np.log(TINY))))
    middle = torch.from_numpy(random.uniform(-0.5, 0.5, 3)).float()
    away = float((shot.eye() - middle).norm())
    focal_mm = float(random.uniform(0.3, 0.9)) * SENSOR_MM * away / (2 * radius)
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = _turned(random), middle
    x, y, z = middle.tolist()
    return Drawn(placed(make(radius), pose), replace(shot, target=(x, y, z), focal_mm=focal_mm))


def _within_sphere(random: np.random.Generator, shot: Shot) -> Drawn:
    """Before a table, or among its legs."""
    solid = table()
    return Drawn(solid, aimed(replace(shot, distance=float(random.uniform(0.05, 0.95))), solid, random))


def _within_solid(random: np.random.Generator, shot: Shot) -> Drawn:
    """A camera in a ball, which sees nothing of it: every ray starts in the solid."""
    return Drawn(primitives.sphere(0.5), replace(shot, distance=float(random.uniform(0.05, 0.45))))


def _across(random: np.random.Generator, sight: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """A direction at right angles to the line of sight, up to a few degrees."""
    across = torch.linalg.cross(sight, torch.from_numpy(random.normal(size=3)).float())
    return across / across.norm() + torch.from_numpy(random.normal(size=3)).float() * 0.03


def _turned(random: np.random.Generator, x_axis: Float[Tensor, "3"] | None = None) -> Float[Tensor, "3 3"]:
    """A random rotation; with an axis, one that turns x into it or away from it."""
    columns = torch.from_numpy(random.normal(size=(3, 3)))
    if x_axis is not None:
        columns[:, 0] = x_axis
    rotation, _ = torch.linalg.qr(columns)
    rotation[:, 2] *= torch.linalg.det(rotation).sign()
    return rotation.float()


NAMES = tuple(families(primitives.sphere(0.5)))
