"""Which way is up: what a user says, how cameras usually look, and the floor that an object stands on."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.points import radius_of, random_subset
from distrace.rays import Rays
from distrace.vectors import perpendicular

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
FLOOR_THICKNESS = 0.02  # of the radius
FLOOR_TILT = 15.0  # degrees
FLOOR_SHARE = 0.05  # of the points, at least
FLOOR_TRIALS = 300
FLOOR_RAYS = 2000  # just below the floor, where nothing of the object is, …
FLOOR_REACH = 1.5  # … within so many radii of its middle
GIVEN_TILT = 0.1  # radians: an object's own up is that near to the given one, or to the floor's normal
PITCHED_TILT = 0.15  # radians: the same about the candidates of a camera's frame
PITCHES = (0.0, 15.0, 30.0)  # degrees, by which a camera looks down


@dataclass(frozen=True)
class Up:
    """Where an object's own up may point: near one of several directions, of which one is the most likely."""

    direction: Float[Tensor, "3"] | None  # None where nothing is known
    candidates: Float[Tensor, "k 3"]
    tilt: float

    @staticmethod
    def along(axis: str) -> "Up":
        """Returns up as a user gives it: an axis of `AXES`, or `unknown`."""
        if axis == "unknown":
            return Up(None, torch.empty(0, 3), torch.inf)
        direction = torch.tensor(AXES[axis], dtype=torch.float32)
        return Up(direction, direction[None], GIVEN_TILT)

    @staticmethod
    def of_camera(rotation: Float[Tensor, "3 3"]) -> "Up":
        """Returns what is likely for a camera, whose y points down: cameras look level, or down.

        `rotation` takes the camera's axes to those of the world.
        """
        pitches = torch.deg2rad(torch.tensor(PITCHES))
        candidates = torch.stack([torch.zeros(len(PITCHES)), -pitches.cos(), -pitches.sin()], dim=1) @ rotation.T
        return Up(candidates[0], candidates, PITCHED_TILT)


@dataclass(frozen=True)
class Floor:
    """A plane: `normal` · x = `height`; what lies less than `thickness` above it belongs to it."""

    normal: Float[Tensor, "3"]
    height: float
    thickness: float


def find_floor(points: Float[Tensor, "n 3"], up: Up) -> Floor | None:
    """Returns the largest plane across up that has hardly any point below it (RANSAC), or None."""
    assert up.direction is not None
    random = torch.Generator().manual_seed(0)
    thickness = FLOOR_THICKNESS * radius_of(points)
    points = random_subset(points, 2000)
    triples = points[torch.randint(len(points), (FLOOR_TRIALS, 3), generator=random)]
    normals = torch.linalg.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=-1)
    normals = normals * (normals @ up.direction).sign()[:, None]
    heights = (triples[:, 0] * normals).sum(-1)
    above = points @ normals.T - heights
    on_plane = (above.abs() < thickness).float().mean(0)
    below = (above < -2 * thickness).float().mean(0)
    degrees = FLOOR_TILT + (max(PITCHES) if len(up.candidates) > 1 else 0.0)
    fits = (normals @ up.direction > np.cos(np.radians(degrees))) & (below < 0.1 * on_plane) & (on_plane > FLOOR_SHARE)
    if not fits.any():
        return None
    best = torch.where(fits, on_plane, 0.0).argmax()
    supports = points[above[:, best].abs() < thickness]
    normal = torch.linalg.svd(supports - supports.mean(0))[2][-1]
    normal = normal * (normal @ up.direction).sign()
    return Floor(normal, float(supports.mean(0) @ normal), thickness)


def rays_below(floor: Floor, points: Float[Tensor, "n 3"]) -> Rays:
    """Returns level rays just below the floor, under the object: nothing of it is there."""
    random = torch.Generator().manual_seed(0)
    side = perpendicular(floor.normal)
    level = torch.stack([side, torch.linalg.cross(floor.normal, side)])
    angles = 2 * np.pi * torch.rand(FLOOR_RAYS, generator=random)
    directions = angles.cos()[:, None] * level[0] + angles.sin()[:, None] * level[1]
    radius = radius_of(points)
    centre = points.median(0).values
    centre = centre - (centre @ floor.normal - floor.height + floor.thickness) * floor.normal
    across = torch.linalg.cross(floor.normal.expand_as(directions), directions)
    offsets = FLOOR_REACH * radius * (2 * torch.rand(FLOOR_RAYS, 1, generator=random) - 1)
    return Rays(centre + offsets * across - 2 * FLOOR_REACH * radius * directions, directions)
