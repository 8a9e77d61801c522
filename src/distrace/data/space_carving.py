"""The sphere around what masks allow: a visual hull on coarse grids, each about what the one before left.

The hull is Laurentini's, *The visual hull concept for silhouette-based image understanding* (PAMI 1994).
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.unit_sphere import ADVICE, UnitSphere, nearest_to_rays, origins_of
from distrace.pixels import thinned

CELLS = 40  # along each axis
ROUNDS = 3
START_FACTOR = 1.5  # radii: what surely holds the object
MARGIN = 1.03
MIN_MASKS_AGREEING = 0.9  # of the masks that see a place: one in ten may be wrong
MAX_PIXELS = 20_000  # pixels of a mask that are looked at for the start
MIN_VIEWS_SEEING = 0.5  # of the views, at least, see what is the object


def within_masks(cameras: Sequence[Camera], masks: Sequence[Bool[Tensor, "_ _"]]) -> UnitSphere:
    """The smallest sphere around what lies in nearly all of the masks, and a margin.

    Raises `ValueError` where nothing does.
    """
    sphere = _around(cameras, masks)
    for _ in range(ROUNDS):
        places = _carved(sphere, cameras, masks)
        if not len(places):
            raise ValueError(
                f"nothing lies within the masks of {len(masks)} views together; are they inverted, or the cameras"
                f" others? If they are right, {ADVICE}"
            )
        sphere = _smallest(places)
    return UnitSphere(sphere.centre, MARGIN * sphere.radius)


def _around(cameras: Sequence[Camera], masks: Sequence[Tensor]) -> UnitSphere:
    """About where the rays of the masks' middles meet, as large as the mask that reaches farthest from there."""
    seen = [camera.rays(camera.pixels()[thinned(mask, MAX_PIXELS)]).directions for camera, mask in zip(cameras, masks)]
    middles = torch.stack([directions.mean(0) for directions in seen]).double()
    origins = origins_of(cameras)
    centre = nearest_to_rays(origins, middles / middles.norm(dim=-1, keepdim=True))
    radius = 0.0
    for origin, directions in zip(origins, seen):
        towards = centre - origin
        cosine = (directions.double() @ towards / towards.norm()).min().clamp(0, 1)
        radius = max(radius, (towards.norm() * (1 - cosine**2).sqrt()).item())
    return UnitSphere(centre, START_FACTOR * radius)


def _carved(sphere: UnitSphere, cameras: Sequence[Camera], masks: Sequence[Tensor]) -> Float[Tensor, "places 3"]:
    """Middles of the cells around a sphere, in the world, that nearly all masks which see them allow."""
    steps = (torch.arange(CELLS, dtype=torch.float64) + 0.5) * 2 / CELLS - 1
    places = sphere.to_world(torch.cartesian_prod(steps, steps, steps))
    reach = math.sqrt(3) * sphere.radius / CELLS
    seen = torch.zeros(len(places))
    allowed = torch.zeros(len(places))
    for camera, mask in zip(cameras, masks):
        inside, hit = _near(camera, mask, places, reach, sphere.centre)
        seen += inside
        allowed += hit
    return places[(seen >= MIN_VIEWS_SEEING * len(cameras)) & (allowed >= MIN_MASKS_AGREEING * seen)]


def _near(
    camera: Camera, mask: Tensor, places: Tensor, reach: float, centre: Tensor
) -> tuple[Bool[Tensor, "places"], Bool[Tensor, "places"]]:
    """Which places project into the image, and which of these so near to the mask that their cell may touch it."""
    distance = (centre - camera.T_world_camera[:3, 3]).norm().item()
    block = max(1, math.ceil(reach * camera.intrinsics[0, 0].item() / distance))
    block = min(block, camera.height, camera.width)
    coarse = torch.nn.functional.max_pool2d(mask[None].float(), block, block, ceil_mode=True)
    coarse = torch.nn.functional.max_pool2d(coarse, 3, 1, 1)[0] > 0
    return looked_up(camera, coarse, places, block)


def looked_up(
    camera: Camera, mask: Bool[Tensor, "_ _"], places: Float[Tensor, "places 3"], block: int = 1
) -> tuple[Bool[Tensor, "places"], Bool[Tensor, "places"]]:
    """Which places project into the image, and which of these into the mask, whose cells are `block` pixels wide."""
    pixels, depths = camera.project(places.to(camera.intrinsics.dtype))
    inside = camera.shows(pixels, depths)
    column, row = (pixels[inside] / block).long().unbind(-1)
    hit = inside.clone()
    hit[inside] = mask[row, column]
    return inside, hit


def _smallest(points: Float[Tensor, "points 3"]) -> UnitSphere:
    """The smallest sphere around points, to a percent: steps to the farthest (Bădoiu and Clarkson, SODA 2003)."""
    centre = points.mean(0)
    for step in range(1, 101):
        centre = centre + (points[(points - centre).norm(dim=-1).argmax()] - centre) / (step + 1)
    return UnitSphere(centre, (points - centre).norm(dim=-1).max().item())
