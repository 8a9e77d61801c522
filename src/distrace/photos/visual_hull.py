"""Space carving by masks: the visual hull as cells and as a distance field, and masks that agree.

Laurentini, *The visual hull concept for silhouette-based image understanding*, PAMI 1994.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean, median

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.data.space_carving import looked_up
from distrace.fields.base import SDF
from distrace.metrics import iou
from distrace.photos.problem import MARCH
from distrace.rays import meet_sphere
from distrace.tracing.sphere_tracing import sphere_trace

CELLS = 160  # along each axis of the cube around the unit sphere
CONSISTENCY_CELLS = 48  # the same, of `consistent_silhouettes`
SILHOUETTE_SIZE = 96  # pixels along the longer side, of silhouettes that are compared: at 48 thin legs are lost

Masks = Sequence[Bool[Tensor, "_ _"]]  # one a view


@dataclass(frozen=True)
class MaskOverlap:
    """Intersection over union of a view's mask and the hull of all masks as the view's camera sees it."""

    name: str
    iou: float
    is_outlier: bool  # most often the camera is wrong


@torch.no_grad()
def mask_overlaps(photographs: Sequence[Photograph]) -> list[MaskOverlap]:
    """How well each photograph's mask agrees with the others'.

    Raises `ValueError` for photographs without masks, or masks without anything in common.
    """
    centres, solid = _carve_finest(photographs, tolerated=0.1, always=1)
    views = [photograph.at_most(SILHOUETTE_SIZE) for photograph in photographs]
    overlaps = _overlaps(solid, views)
    limit = outlier_limit([1 - overlap for overlap in overlaps], 0.15)

    def is_outlier(number: int) -> bool:
        """A view that alone sees through a hole is none: without that part the others overlap as before.

        A wrong camera rules out parts that the others show.
        """
        if 1 - overlaps[number] <= limit:
            return False
        inside, on_object = looked_up(photographs[number].camera, photographs[number].known_mask, centres)
        carved = _overlaps(solid & ~(inside & ~on_object), views)
        lost = [before - after for view, (before, after) in enumerate(zip(overlaps, carved)) if view != number]
        return 1 - carved[number] > limit or mean(lost) > 0.01

    return [MaskOverlap(each.name, overlaps[number], is_outlier(number)) for number, each in enumerate(photographs)]


def outlier_limit(differences: Sequence[float], least: float) -> float:
    """The largest difference of an inlier: 2.5 × the median, or `least` where nearly all agree; inf for none."""
    return max(2.5 * median(differences), least) if differences else math.inf


def visual_hull(photographs: Sequence[Photograph]) -> SDF:
    """The signed distance from the hull of nearly all masks within the unit sphere, to about a cell.

    Raises `ValueError` for photographs without masks, or masks without anything in common.
    """
    return _distance_field(_carve_finest(photographs, tolerated=0.05)[1])


def _carve_finest(
    photographs: Sequence[Photograph], tolerated: float, always: int = 0
) -> tuple[Float[Tensor, "cells 3"], Bool[Tensor, "cells"]]:
    """`carve` on the finest grid; raises `ValueError` where nothing is left."""
    cameras = [photograph.camera for photograph in photographs]
    centres, solid = carve(cameras, [photograph.known_mask for photograph in photographs], CELLS, tolerated, always)
    if not solid.any():
        raise ValueError(
            f"nothing lies within the masks of {len(photographs)} views together; are they inverted, or the cameras"
            " others?"
        )
    return centres, solid


@torch.no_grad()
def carve(
    cameras: Sequence[Camera], masks: Masks, cells: int, tolerated: float, always: int = 0
) -> tuple[Float[Tensor, "cells 3"], Bool[Tensor, "cells"]]:
    """Centres of `cells`³ cells of the cube about the unit sphere, and which of them the masks contain.

    A cell must lie in a quarter of the images, and in two at least. Of these, the masks of a share `tolerated`, and
    `always` in any case, may leave it out.
    """
    steps = (torch.arange(cells, device=cameras[0].intrinsics.device) + 0.5) * 2 / cells - 1
    centres = torch.cartesian_prod(steps, steps, steps)
    visible = torch.zeros_like(centres[:, 0])
    left_out = torch.zeros_like(visible)
    for camera, mask in zip(cameras, masks, strict=True):
        inside, on_object = looked_up(camera, mask, centres)
        visible += inside
        left_out += inside & ~on_object
    enough = visible >= max(2.0, 0.25 * len(cameras))
    return centres, enough & (left_out <= (tolerated * visible).clamp_min(always)) & (centres.norm(dim=-1) < 1)


def _distance_field(solid: Bool[Tensor, "cells"]) -> SDF:
    """The signed distance from the solid cells of a cubic grid, linear between their centres."""
    from scipy.ndimage import distance_transform_edt

    cells = round(len(solid) ** (1 / 3))
    solid = solid.reshape(cells, cells, cells)
    outside, within = (torch.from_numpy(distance_transform_edt(part.numpy())).float() for part in (~solid, solid))
    grid = ((outside - within) * 2 / cells)[None, None]

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        positions = points.reshape(1, 1, 1, -1, 3).flip(-1).cpu()  # grid_sample's x is the last axis
        values = F.grid_sample(grid, positions, padding_mode="border", align_corners=False)
        return values.reshape(points.shape[:-1]).to(points)

    return field


def _overlaps(solid: Bool[Tensor, "cells"], views: Sequence[Photograph]) -> list[float]:
    """Intersection over union of each view's mask and the solid's silhouette."""
    hull = _distance_field(solid)
    overlaps = []
    for view in views:
        rays = view.camera.rays()
        overlaps.append(iou(sphere_trace(hull, rays, meet_sphere(rays), MARCH).hit, view.known_mask))
    return overlaps


def consistent_silhouettes(cameras: Sequence[Camera], masks: Masks) -> list[Bool[Tensor, "_ _"]]:
    """The silhouettes of the cells that at least 85 % of the masks about each contain.

    A neighbour that looks like the object in one view is not in them. After Campbell et al., *Automatic 3D object
    segmentation in multiple views using volumetric graph-cuts* (BMVC 2007), with votes in place of a graph cut.
    """
    centres, solid = carve(cameras, masks, CONSISTENCY_CELLS, tolerated=0.15)
    return [_silhouette(camera, centres[solid]) for camera in cameras]


def _silhouette(camera: Camera, centres: Float[Tensor, "n 3"]) -> Bool[Tensor, "height width"]:
    """The pixels that cells cover, widened by half of the nearest cell's diagonal."""
    pixels, depths = camera.project(centres)
    inside = camera.shows(pixels, depths)
    covered = depths.new_zeros(camera.height, camera.width)
    if not inside.any():
        return covered.bool()
    column, row = pixels[inside].long().T
    covered[row, column] = 1.0
    radius = math.sqrt(3) / CONSISTENCY_CELLS * float(camera.intrinsics[0, 0] / depths[inside].min())
    reach = min(math.ceil(radius), max(camera.height, camera.width))
    for _ in range(2):  # rows and then columns take less time than a large square
        covered = F.max_pool1d(F.pad(covered, (reach, reach)), 2 * reach + 1, 1).T
    return covered > 0
