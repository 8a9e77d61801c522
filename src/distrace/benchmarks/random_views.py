"""Random codes and cameras to measure a tracer on.

Distance and focal length are drawn independently, so the object is sometimes cut off and sometimes tiny.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF, value_and_gradient

SENSOR_MM = 32.0
DISTANCES = (1.6, 12.0)  # of the eye from the origin, in radii
FOCALS_MM = (18.0, 200.0)
ELEVATIONS = (-30.0, 70.0)  # degrees
CANDIDATES = 256  # points near which a camera may aim
NEWTON_STEPS = 4  # from the best of them to the surface


@dataclass(frozen=True)
class Shot:
    """A camera in the numbers that are drawn: angles in degrees, lengths in radii of the unit sphere."""

    azimuth: float
    elevation: float
    distance: float  # of the eye from the origin
    focal_mm: float  # with a sensor of 32 mm
    target: tuple[float, float, float]  # the point in the middle of the image
    size: int  # pixels along each side

    def camera(self) -> Camera:
        target = torch.tensor(self.target)
        return Camera.look_at(
            self.eye(), target, height=self.size, width=self.size, focal_mm=self.focal_mm, sensor_mm=SENSOR_MM
        )

    def eye(self) -> Float[Tensor, "3"]:
        return Camera.orbit(self.azimuth, self.elevation, self.distance).T_world_camera[:3, 3]

    def pixel(self, point: Float[Tensor, "3"]) -> float:
        """Returns the width of one pixel at a point in the middle of the image, in radii."""
        return float((self.eye() - point).norm()) * SENSOR_MM / (self.focal_mm * self.size)


@dataclass(frozen=True)
class Mixture:
    """A code between two training codes: (1 − share) · first + share · second."""

    first: int
    second: int
    share: float


@dataclass(frozen=True)
class RandomView:
    """A field and a camera. The reference divides the field by its Lipschitz constant."""

    model: str
    code: int | Mixture | None  # None for an analytic field
    sdf: SDF
    shot: Shot
    lipschitz: float = 1.0
    device: torch.device = torch.device("cpu")

    def camera(self) -> Camera:
        return self.shot.camera().to(self.device)


def model_views(model: Model, count: int, sizes: tuple[int, int], seed: int) -> Iterator[RandomView]:
    """Draws codes and cameras. Every third code lies between two training codes; a larger count appends views.

    Raises `ValueError` for sizes that no image has.
    """
    random = np.random.default_rng(seed)
    codes = model.codes
    for number in range(count):
        if number % 3 == 2:
            first, second = (int(number) for number in random.integers(len(codes), size=2))
            code = Mixture(first, second, float(random.uniform()))
            field = model.field(torch.lerp(codes[first], codes[second], code.share))
        else:
            code = int(random.integers(len(codes)))
            field = model.field(code)
        shot = aim_at_surface(draw_shot(random, sizes), field, random, codes.device)
        yield RandomView(model.name, code, field, shot, device=codes.device)


def draw_shot(random: np.random.Generator, sizes: tuple[int, int]) -> Shot:
    """Draws a camera that looks at the origin; distance and focal length are uniform in their logarithms.

    The density of sizes falls with their cube, so that each octave of sizes costs about the same. Raises `ValueError`
    for sizes that no image has.
    """
    low, high = sizes
    if not 1 <= low <= high:
        raise ValueError(f"sizes from {low} to {high} pixels were given; give the smallest first, at least 1")
    return Shot(
        azimuth=float(random.uniform(0, 360)),
        elevation=float(random.uniform(*ELEVATIONS)),
        distance=float(np.exp(random.uniform(*np.log(DISTANCES)))),
        focal_mm=float(np.exp(random.uniform(*np.log(FOCALS_MM)))),
        target=(0.0, 0.0, 0.0),
        size=round(float(random.uniform(high**-2, low**-2)) ** -0.5),
    )


@torch.no_grad()
def aim_at_surface(
    shot: Shot, sdf: SDF, random: np.random.Generator, device: torch.device = torch.device("cpu")
) -> Shot:
    """Returns the shot with its target at a random point near the surface, so that a long lens sees some of it."""
    points = torch.from_numpy(random.uniform(-0.6, 0.6, (CANDIDATES, 3))).float().to(device)
    point = points[sdf(points).abs().argmin()]
    for _ in range(NEWTON_STEPS):
        value, gradient = value_and_gradient(sdf, point[None])
        step = (value[:, None] * gradient / gradient.square().sum().clamp_min(1e-6))[0]
        point = point - step * (0.2 / step.norm().clamp_min(1e-9)).clamp_max(1.0)
    x, y, z = point.clamp(-0.9, 0.9).tolist()
    return replace(shot, target=(x, y, z))
