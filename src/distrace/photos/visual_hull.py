"""What masks allow, and matches: a visual hull on a grid, as a field of distances that a network can begin with.

Laurentini, *The visual hull concept for silhouette-based image understanding*, PAMI 1994.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean, median

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional as F

from distrace.data.photograph import Photograph
from distrace.data.space_carving import looked_up
from distrace.fields.base import SDF
from distrace.metrics import iou
from distrace.rays import meet_sphere
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace

CELLS = 160  # along each axis of the cube around the unit sphere
SEEN = 0.25  # of the views, and two at least, must have seen a place
WRONG = 0.05  # of the masks that see a place may leave it out …
ONE_WRONG = 0.1  # … and so many, one at least, where it is to be found out which are wrong
COARSE = 96  # pixels along the longer side, of views that are compared
FAR_OFF = 2.5  # × the median over views: a view whose outline is off by more is doubtful …
NOTICEABLE = 0.15  # … if so much of it is, too, …
MISSED = 0.01  # … unless the others' overlaps hardly lack what it rules out
MARCH = TraceConfig(coarse_levels=0, step_scale=1.0, tolerance=2e-3, steps=60, least_step=4e-3)


@dataclass(frozen=True)
class Overlap:
    """Intersection over union of a view's mask and the hull of all, as its camera sees it."""

    name: str
    iou: float
    doubtful: bool


@torch.no_grad()
def overlaps(photographs: Sequence[Photograph]) -> list[Overlap]:
    """How well each photograph's outline agrees with the others': one that does not most often has a wrong camera.

    Raises `ValueError` for photographs without masks, or masks without anything in common.
    """
    places, solid = _allowed(photographs, ONE_WRONG, least=1.0)
    views = [each.at_most(COARSE) for each in photographs]
    found = _ious(solid, views)
    limit = max(NOTICEABLE, FAR_OFF * median(1 - iou for iou in found))

    def doubtful(number: int) -> bool:
        """Not if its mask alone rules out what hardly another sees: then nothing lacks it.

        A wrong camera takes away what others show.
        """
        if 1 - found[number] <= limit:
            return False
        inside, on_object = looked_up(photographs[number].camera, photographs[number].known_mask, places)
        again = _ious(solid & ~(inside & ~on_object), views)
        lost = [before - after for each, (before, after) in enumerate(zip(found, again)) if each != number]
        return 1 - again[number] > limit or mean(lost) > MISSED

    return [Overlap(each.name, found[number], doubtful(number)) for number, each in enumerate(photographs)]


def _ious(solid: Bool[Tensor, "places"], views: Sequence[Photograph]) -> list[float]:
    """Of each view's mask and of what its camera sees of a solid."""
    hull, found = _distances(solid), []
    for each in views:
        rays = each.camera.rays()
        found.append(iou(sphere_trace(hull, rays, meet_sphere(rays), MARCH).hit, each.known_mask))
    return found


def visual_hull(photographs: Sequence[Photograph]) -> SDF:
    """The distance from the surface of what nearly all masks allow in the unit sphere, to about a cell.

    Raises `ValueError` for photographs without masks, or masks without anything in common.
    """
    return _distances(_allowed(photographs, WRONG)[1])


def _allowed(photographs: Sequence[Photograph], wrong: float, least: float = 0.0) -> tuple[Tensor, Tensor]:
    """On the finest grid; a share of the masks that see a place, and `least` of them, may leave it out."""
    places, solid = allowed(photographs, CELLS, wrong, least)
    if not solid.any():
        raise ValueError(
            f"nothing lies within the masks of {len(photographs)} views together; are they inverted, or the cameras"
            " others?"
        )
    return places, solid


@torch.no_grad()
def allowed(
    photographs: Sequence[Photograph], cells: int, wrong: float = WRONG, least: float = 0.0
) -> tuple[Float[Tensor, "places 3"], Bool[Tensor, "places"]]:
    """The middles of cells about the unit sphere, and which of them masks allow: but `wrong` of those that see it."""
    places = cells_about(cells, photographs[0].image.device)
    seen, left_out = torch.zeros_like(places[:, 0]), torch.zeros_like(places[:, 0])
    for each in photographs:
        inside, on_object = looked_up(each.camera, each.known_mask, places)
        seen += inside
        left_out += inside & ~on_object
    return places, let_by(seen, left_out, len(photographs), wrong, least) & (places.norm(dim=-1) < 1)


def cells_about(cells: int, device: torch.device) -> Float[Tensor, "places 3"]:
    """The middles of a cube's cells about the unit sphere, as many along each axis."""
    steps = (torch.arange(cells, device=device) + 0.5) * 2 / cells - 1
    return torch.cartesian_prod(steps, steps, steps)


def let_by(
    seen: Float[Tensor, "places"], left_out: Float[Tensor, "places"], views: int, wrong: float, least: float = 0.0
) -> Bool[Tensor, "places"]:
    """Places that enough of the views see, of which but a share leaves them out, or but `least` of them."""
    return (seen >= max(2.0, SEEN * views)) & (left_out <= (wrong * seen).clamp_min(least))


def _distances(solid: Bool[Tensor, "places"]) -> SDF:
    """Between the middles of the finest grid's cells linearly."""
    solid = solid.reshape(CELLS, CELLS, CELLS)
    outside, within = (torch.from_numpy(distance_transform_edt(part.numpy())).float() for part in (~solid, solid))
    grid = ((outside - within) * 2 / CELLS)[None, None]

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        at = points.reshape(1, 1, 1, -1, 3).flip(-1).cpu()  # grid_sample's x is the last axis
        found = F.grid_sample(grid, at, padding_mode="border", align_corners=False)
        return found.reshape(points.shape[:-1]).to(points)

    return field
