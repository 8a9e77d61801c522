"""The unit sphere in the world of a folder of photographs, as given or estimated."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.pose import Similarity

MIN_POINTS = 20  # points that locate an object
POINTS_INSIDE = 0.9  # of the points are within the sphere; the others are background and outliers
MARGIN = 1.1
MAX_COORDINATE = 1e30  # largest coordinate
MIN_INFORMATION = 1e-4  # of what the information on the worst known direction would be from all sides
ADVICE = "tell where the object is as unit_sphere in views.json"


@dataclass(frozen=True)
class UnitSphere:
    """World = centre + radius · unit: centre and radius of the unit sphere, in the units of the folder's world."""

    centre: Float[Tensor, "3"]  # in double: worlds may lie far from their origin
    radius: float

    @property
    def similarity(self) -> Similarity:
        """Of the unit sphere in the world, in double."""
        return Similarity(torch.eye(3).double(), self.centre, torch.tensor(self.radius).double())

    def to_world(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        centre = self.centre.to(points.device)
        return (centre + self.radius * points.to(centre.dtype)).to(points.dtype)

    def to_unit(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        centre = self.centre.to(points.device)
        return ((points.to(centre.dtype) - centre) / self.radius).to(points.dtype)

    def camera_to_world(self, camera: Camera) -> Camera:
        return _moved(camera, self.to_world(camera.T_world_camera[..., :3, 3]))

    def camera_to_unit(self, camera: Camera) -> Camera:
        return _moved(camera, self.to_unit(camera.T_world_camera[..., :3, 3]))

    def described(self) -> dict[str, object]:
        """As `unit_sphere` has it, in views.json and in results."""
        return {"centre": self.centre.tolist(), "radius": self.radius}


def unit_sphere_of(described: object) -> UnitSphere:
    """Reads what `UnitSphere.described` returns. Raises `ValueError` for anything else."""
    if not isinstance(described, dict):
        raise ValueError(f"it is {described!r}; it has a centre and a radius")
    centre = described.get("centre")
    radius = described.get("radius")
    numbers: list[Any] = [*centre, radius] if isinstance(centre, list) else []
    finite = all(isinstance(value, int | float) and abs(value) <= MAX_COORDINATE for value in numbers)
    if len(numbers) != 4 or not finite or not numbers[3] > 0:
        raise ValueError(
            f"its centre is {centre} and its radius {radius}; three numbers and a positive one are needed, in the units"
            " of T_world_camera"
        )
    return UnitSphere(torch.tensor(numbers[:3], dtype=torch.float64), float(numbers[3]))


def among_points(points: Float[np.ndarray, "points 3"]) -> UnitSphere | None:
    """The sphere around the median of points that holds nine in ten of them, and a margin; None for too few."""
    if len(points) < MIN_POINTS:
        return None
    positions = torch.from_numpy(points).double()
    centre = positions.median(0).values
    radius = (positions - centre).norm(dim=-1).quantile(POINTS_INSIDE).item() * MARGIN
    return UnitSphere(centre, radius) if radius > 0 else None


def between_axes(cameras: Sequence[Camera]) -> UnitSphere:
    """The sphere around what the views show whole, about the point nearest to the rays of their middles.

    Its radius is the median of distance · sin(half of the diagonal field of view): of the smaller field, as much as
    fits into the views, it would cut off a third of Middlebury's temple. Raises `ValueError` where the rays are
    parallel, or meet behind the cameras.
    """
    middles = torch.cat([camera.rays(_middle(camera)).directions for camera in cameras]).double()
    centre = nearest_to_rays(origins_of(cameras), middles)
    distance = (centre - origins_of(cameras)).norm(dim=-1)
    half = torch.stack([_half_field(camera) for camera in cameras]).double()
    return UnitSphere(centre, (distance * half.sin()).median().item())


def origins_of(cameras: Sequence[Camera]) -> Float[Tensor, "views 3"]:
    return torch.stack([camera.T_world_camera[:3, 3] for camera in cameras]).double()


def nearest_to_rays(origins: Float[Tensor, "views 3"], directions: Float[Tensor, "views 3"]) -> Float[Tensor, "3"]:
    """The point with the least sum of squared distances to lines: Σ (I − d dᵀ) (x − o) = 0.

    Raises `ValueError` where they are parallel to about a degree, or the point is behind half of the origins.
    """
    across = torch.eye(3, dtype=origins.dtype) - directions[:, :, None] * directions[:, None]
    if torch.linalg.eigvalsh(across.mean(0))[0] < MIN_INFORMATION:
        raise ValueError(f"the {len(origins)} views look in one direction, so their axes meet nowhere; {ADVICE}")
    point = torch.linalg.solve(across.sum(0), (across @ origins[..., None]).sum(0))[:, 0]
    if ((point - origins) * directions).sum(-1).median() <= 0:
        raise ValueError(f"the views look away from each other: their axes meet behind the cameras; {ADVICE}")
    return point


def _moved(camera: Camera, place: Float[Tensor, "*batch 3"]) -> Camera:
    pose = camera.T_world_camera.clone()
    pose[..., :3, 3] = place
    return replace(camera, T_world_camera=pose)


def _middle(camera: Camera) -> Float[Tensor, "1 2"]:
    return camera.intrinsics.new_tensor([[camera.width / 2, camera.height / 2]])


def _half_field(camera: Camera) -> Float[Tensor, ""]:
    """The largest angle, in radians, between the ray of the image's middle and those of its corners."""
    corners = [[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]]
    towards = camera.rays(camera.intrinsics.new_tensor(corners)).directions
    return torch.acos((towards @ camera.rays(_middle(camera)).directions[0]).clamp(-1, 1)).max()
