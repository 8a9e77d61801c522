"""Space carving by masks: the visual hull as a distance field, outlier masks, and masks that are consistent.

Laurentini, *The visual hull concept for silhouette-based image understanding*, PAMI 1994.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean, median

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.data.space_carving import looked_up
from distrace.fields.base import SDF
from distrace.metrics import iou
from distrace.rays import meet_sphere
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace

CELLS = 160  # along each axis of the cube around the unit sphere
CONSISTENCY_CELLS = 48  # the same, of `CrossViewConsistency`
LEAST_VISIBILITY = 0.25  # share of the views, and two at least, whose images must contain a cell
WRONG_MASKS = 0.05  # share of the masks about a cell that may leave it out …
WRONG_MASKS_SOUGHT = 0.1  # … and, one at least, where the wrong ones are sought
INCONSISTENT_VIEWS = 0.15  # share of the views of a cell that may take it for the background: parts may look like that
COMPARED_SIZE = 96  # pixels along the longer side, of views that are compared
OUTLIER_FACTOR = 2.5  # × the median over views: a view whose 1 − IoU is larger is an outlier …
LEAST_DISAGREEMENT = 0.15  # … if that is larger than this, too, …
LEAST_LOSS = 0.01  # … unless the others' overlaps lose less than this by what the view rules out
MARCH = TraceConfig(coarse_levels=0, step_scale=1.0, tolerance=2e-3, steps=60, least_step=4e-3)


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
    centres, solid = _carve_finest(photographs, WRONG_MASKS_SOUGHT, least=1.0)
    views = [photograph.at_most(COMPARED_SIZE) for photograph in photographs]
    overlaps = _overlaps(solid, views)
    limit = max(LEAST_DISAGREEMENT, OUTLIER_FACTOR * median(1 - overlap for overlap in overlaps))

    def is_outlier(number: int) -> bool:
        """A view that alone sees through a hole is none: nothing is missing from the others without that part.

        A wrong camera rules out parts that the others show.
        """
        if 1 - overlaps[number] <= limit:
            return False
        inside, on_object = looked_up(photographs[number].camera, photographs[number].known_mask, centres)
        carved = _overlaps(solid & ~(inside & ~on_object), views)
        lost = [before - after for view, (before, after) in enumerate(zip(overlaps, carved)) if view != number]
        return 1 - carved[number] > limit or mean(lost) > LEAST_LOSS

    return [MaskOverlap(each.name, overlaps[number], is_outlier(number)) for number, each in enumerate(photographs)]


def _overlaps(solid: Bool[Tensor, "cells"], views: Sequence[Photograph]) -> list[float]:
    """Intersection over union of each view's mask and the solid's silhouette."""
    hull = _distance_field(solid)
    overlaps = []
    for view in views:
        rays = view.camera.rays()
        overlaps.append(iou(sphere_trace(hull, rays, meet_sphere(rays), MARCH).hit, view.known_mask))
    return overlaps


def visual_hull(photographs: Sequence[Photograph]) -> SDF:
    """The signed distance from the hull of nearly all masks within the unit sphere, to about a cell.

    Raises `ValueError` for photographs without masks, or masks without anything in common.
    """
    return _distance_field(_carve_finest(photographs, WRONG_MASKS)[1])


def _carve_finest(photographs: Sequence[Photograph], wrong: float, least: float = 0.0) -> tuple[Tensor, Tensor]:
    """`carve` on the finest grid; raises `ValueError` where nothing is left."""
    centres, solid = carve(photographs, CELLS, wrong, least)
    if not solid.any():
        raise ValueError(
            f"nothing lies within the masks of {len(photographs)} views together; are they inverted, or the cameras"
            " others?"
        )
    return centres, solid


@torch.no_grad()
def carve(
    photographs: Sequence[Photograph], cells: int, wrong: float = WRONG_MASKS, least: float = 0.0
) -> tuple[Float[Tensor, "cells 3"], Bool[Tensor, "cells"]]:
    """Centres of a grid's cells about the unit sphere, and which cells lie within the masks.

    `wrong` is the share of the masks about a cell that may leave it out; `least` of them always may.
    Raises `ValueError` for photographs without masks.
    """
    centres = grid_centres(cells, photographs[0].image.device)
    visible = torch.zeros_like(centres[:, 0])
    left_out = torch.zeros_like(visible)
    for photograph in photographs:
        inside, on_object = looked_up(photograph.camera, photograph.known_mask, centres)
        visible += inside
        left_out += inside & ~on_object
    return centres, _is_solid(visible, left_out, len(photographs), wrong, least) & (centres.norm(dim=-1) < 1)


def grid_centres(cells: int, device: torch.device) -> Float[Tensor, "cells 3"]:
    """The centres of `cells`³ cells of the cube about the unit sphere."""
    steps = (torch.arange(cells, device=device) + 0.5) * 2 / cells - 1
    return torch.cartesian_prod(steps, steps, steps)


def _is_solid(
    visible: Float[Tensor, "cells"], left_out: Float[Tensor, "cells"], views: int, wrong: float, least: float = 0.0
) -> Bool[Tensor, "cells"]:
    """Cells that enough of the views contain, and that few of those leave out; both are counts of views."""
    return (visible >= max(2.0, LEAST_VISIBILITY * views)) & (left_out <= (wrong * visible).clamp_min(least))


def _distance_field(solid: Bool[Tensor, "cells"]) -> SDF:
    """The signed distance from the solid cells of the finest grid, linear between their centres."""
    from scipy.ndimage import distance_transform_edt

    solid = solid.reshape(CELLS, CELLS, CELLS)
    outside, within = (torch.from_numpy(distance_transform_edt(part.numpy())).float() for part in (~solid, solid))
    grid = ((outside - within) * 2 / CELLS)[None, None]

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        positions = points.reshape(1, 1, 1, -1, 3).flip(-1).cpu()  # grid_sample's x is the last axis
        values = F.grid_sample(grid, positions, padding_mode="border", align_corners=False)
        return values.reshape(points.shape[:-1]).to(points)

    return field


@dataclass(frozen=True)
class CrossViewConsistency:
    """The unit sphere's cells as each view sees them: projected once, and used for every shape.

    After Campbell et al., *Automatic 3D object segmentation in multiple views using volumetric graph-cuts* (BMVC
    2007); here the views vote in place of a graph cut.
    """

    cameras: Sequence[Camera]
    inside: Bool[Tensor, "views cells"]
    pixel: Int[Tensor, "views cells"]  # flat index; 0 for cells outside the image
    depth: Float[Tensor, "views cells"]

    @staticmethod
    def of(cameras: Sequence[Camera]) -> "CrossViewConsistency":
        """Projects the cells into each camera's image."""
        centres = grid_centres(CONSISTENCY_CELLS, cameras[0].intrinsics.device)
        centres = centres[centres.norm(dim=-1) < 1]
        projections = []
        for camera in cameras:
            pixels, depth = camera.project(centres)
            inside = camera.shows(pixels, depth)
            column, row = pixels.masked_fill(~inside[:, None], 0.0).long().T
            projections.append((inside, row * camera.width + column, depth))
        return CrossViewConsistency(cameras, *(torch.stack(part) for part in zip(*projections)))

    def silhouettes(self, masks: Sequence[Bool[Tensor, "_ _"]]) -> list[Bool[Tensor, "_ _"]]:
        """The silhouettes of the cells that most of the masks, one a view, contain.

        A neighbour that looks like the object in one view is not in them.
        """
        on_object = torch.stack([mask.reshape(-1)[pixel] for mask, pixel in zip(masks, self.pixel, strict=True)])
        visible = self.inside.sum(0).float()
        left_out = (self.inside & ~on_object).sum(0).float()
        solid = _is_solid(visible, left_out, len(masks), INCONSISTENT_VIEWS)
        return [
            _silhouette(camera, pixel[solid & inside], depth[solid & inside])
            for camera, inside, pixel, depth in zip(self.cameras, self.inside, self.pixel, self.depth)
        ]


def _silhouette(camera: Camera, pixel: Int[Tensor, "n"], depth: Float[Tensor, "n"]) -> Bool[Tensor, "height width"]:
    """The pixels that cells cover, widened by half of the nearest cell's diagonal."""
    covered = depth.new_zeros(camera.height, camera.width)
    covered.view(-1)[pixel] = 1.0
    if not len(pixel):
        return covered.bool()
    radius = math.sqrt(3) / CONSISTENCY_CELLS * float(camera.intrinsics[0, 0] / depth.min())
    reach = min(math.ceil(radius), max(camera.height, camera.width))
    for _ in range(2):  # rows and then columns take less time than a large square
        covered = F.max_pool1d(F.pad(covered, (reach, reach)), 2 * reach + 1, 1).T
    return covered > 0
