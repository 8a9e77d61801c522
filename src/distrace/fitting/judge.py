"""The verdict on a completion: how much of the scan it explains, what it contradicts, and whether other fits agree."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.data.scan import Scan
from distrace.fields.base import SDF, clamped_to_ball
from distrace.pose import Similarity
from distrace.rays import Bounds, meet_sphere
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace

NEAR = 0.03  # of the shape's radius: a point that near to the surface is explained by it
BLOCKED = 0.03  # radii of the unit sphere: a shape that far before the end of a ray blocks it
INSIDE = (0.005, 0.01, 0.02, 0.04)  # radii of the unit sphere: so far behind a point there is an inside
MOST_RAYS = 600
MOST_NOISE = 0.01  # of the shape's radius: twice so much noise is excused, besides
SEEN = (0.65, 0.1)  # share of its length along each axis that was seen, of what is trusted, and of what has not failed
SURFACE_POINTS = 500
OUTER = (0.02, 0.98)  # quantiles between which points or a surface span
TRUSTED = (0.9, 0.1, 0.05)  # least explained, most blocked, most disagreement
MOST_PRIOR_DEVIATION = 4.0  # of what is trusted, in units of the placement prior's deviations
FAILED = (0.7, 0.2)  # least explained, most blocked
SILHOUETTE = (0.85, 0.6)  # least intersection over union of what is trusted, and of what has not failed


@dataclass(frozen=True)
class Verdict:
    """`trusted`, `doubtful` or `failed`, the numbers behind it, and a sentence that says why."""

    name: str
    explained: float  # share of the scan's points that lie near the surface
    blocked: float  # share of the rays of free space, of those near the object, that pass through the shape
    seen: float  # share of the shape's length that the points span, along the axis where it is least
    disagreement: float  # how far the other good ends lie from the surface, in sizes; 0 where there are none
    silhouette: float | None  # intersection over union with the mask, where that is the object's alone
    prior_deviation: float | None  # of size or centre from the placement prior, in its deviations; None without one
    reason: str

    def facts(self) -> dict[str, float | str | None]:
        return {
            "verdict": self.name,
            "explained": round(self.explained, 4),
            "free_space_violated": round(self.blocked, 4),
            "extent_seen": round(self.seen, 4),
            "disagreement": round(self.disagreement, 4),
            "silhouette_iou": self.silhouette if self.silhouette is None else round(self.silhouette, 4),
            "placement_deviation": None if self.prior_deviation is None else round(self.prior_deviation, 2),
            "reason": self.reason,
        }


@torch.no_grad()
def judged(
    scan: Scan,
    sdf: SDF,
    place: Similarity,
    others: Sequence[tuple[SDF, Similarity]] = (),
    silhouette: float | None = None,
    prior_deviation: float | None = None,
) -> Verdict:
    """Returns the verdict on a placed shape; `others` are the placed shapes of fits that are nearly as good.

    `prior_deviation` is that of its size or centre from the placement prior.
    """
    surface = points_on_zero_set(sdf, SURFACE_POINTS, scan.points)
    disagreement = disagreement_of(place.to_world(surface), place, others)
    reach = _reach(surface)
    noise = 2 * min(scan.noise / float(place.scale), MOST_NOISE * reach)
    away = distances(scan.points, sdf, place) - noise
    near = (away < NEAR * reach) & _have_inside(place.to_object(scan.points), sdf)
    explained = float(near.float().mean()) if len(near) else 1.0
    seen = _extent_seen(place.to_object(scan.points[near]), surface) if len(near) else 1.0
    blocked = _blocked_share(scan, sdf, place, noise)
    reasons = [] if len(near) else ["no point of the surface is known"]
    if explained < TRUSTED[0]:
        reasons.append(f"{1 - explained:.0%} of the points lie away from the surface")
    if blocked > TRUSTED[1]:
        reasons.append(f"the shape blocks {blocked:.0%} of the rays of free space")
    if disagreement > TRUSTED[2]:
        reasons.append(f"another fit that is as good lies {disagreement:.0%} of the size away")
    if seen < SEEN[0]:
        reasons.append(f"the points span {seen:.0%} of its length along one axis: the rest is a guess")
    if prior_deviation is not None and prior_deviation > MOST_PRIOR_DEVIATION:
        reasons.append("objects of the class that look like that are usually of another size, or elsewhere")
    overlap = 1.0 if silhouette is None else silhouette
    if overlap < SILHOUETTE[0]:
        reasons.append(f"its silhouette and the mask have an intersection over union of {overlap:.0%}")
    failed = explained < FAILED[0] or blocked > FAILED[1] or seen < SEEN[1] or overlap < SILHOUETTE[1]
    name = "failed" if failed else "doubtful" if reasons else "trusted"
    usual = f"{explained:.0%} of the points lie on the surface, and "
    if len(scan.free_until):
        usual += f"it blocks {blocked:.0%} of the rays of free space"
    else:
        usual += "no free space is known"
    return Verdict(
        name, explained, blocked, seen, disagreement, silhouette, prior_deviation, "; ".join(reasons) or usual
    )


def _have_inside(points: Float[Tensor, "n 3"], sdf: SDF) -> Bool[Tensor, "n"]:
    """Returns whether the inside is near: about thin sheets a field may be small and never negative."""
    with torch.enable_grad():
        at = points.detach().requires_grad_()
        values = sdf(at)
        (slopes,) = torch.autograd.grad(values.sum(), at)
    inwards = -torch.nn.functional.normalize(slopes, dim=-1)
    depths = points.new_tensor(INSIDE)
    behind = sdf(points[:, None] + depths[:, None] * inwards[:, None])
    return (values.detach() < 0) | (behind < 0).any(1)


def _extent_seen(points: Float[Tensor, "n 3"], surface: Float[Tensor, "m 3"]) -> float:
    """Returns the least share, over the object's axes, of the surface's length that points span; outliers left out."""
    if not len(points) or not len(surface):
        return 0.0
    quantiles = points.new_tensor(OUTER)
    spanned = points.quantile(quantiles, dim=0).diff(dim=0)[0]
    length = surface.quantile(quantiles, dim=0).diff(dim=0)[0]
    return float((spanned / length.clamp_min(1e-6)).min().clamp(0, 1))


def _reach(surface: Float[Tensor, "m 3"]) -> float:
    """Returns the radius of a surface about its middle: a shape may be much smaller than the unit sphere."""
    if not len(surface):
        return 1.0
    return float((surface - surface.median(dim=0).values).norm(dim=-1).max())


def distances(points: Float[Tensor, "n 3"], sdf: SDF, place: Similarity) -> Float[Tensor, "n"]:
    """How far points of the scan's frame are from the surface, in radii of the unit sphere."""
    within, beyond = clamped_to_ball(place.to_object(points))
    return (sdf(within) + beyond).abs()


@torch.no_grad()
def disagreement_of(
    surface: Float[Tensor, "n 3"], place: Similarity, others: Sequence[tuple[SDF, Similarity]]
) -> float:
    """How far the farthest other end lies, in the mean, from points of a surface; in sizes of the latter."""
    apart = [float(distances(surface, sdf, other).mean() * other.scale / place.scale) for sdf, other in others]
    return max(apart, default=0.0)


@torch.no_grad()
def points_on_zero_set(sdf: SDF, count: int, like: Tensor, seed: int = 0) -> Float[Tensor, "n 3"]:
    """Returns points on a surface in the unit sphere, by Newton steps from points about it; some fall off."""
    random = torch.Generator().manual_seed(seed)
    points = torch.rand(20 * count, 3, generator=random).to(like) * 2 - 1
    points = points[points.norm(dim=-1) < 1]
    near = sdf(points).abs().argsort()[: 2 * count]
    points = points[near]
    for _ in range(4):
        with torch.enable_grad():
            at = points.detach().requires_grad_()
            values = sdf(at)
            (slope,) = torch.autograd.grad(values.sum(), at)
        points = points - (values.detach() / slope.square().sum(-1).clamp_min(0.1))[:, None] * slope
    return points[(points.norm(dim=-1) < 1) & (sdf(points).abs() < 1e-2)][:count]


def _blocked_share(scan: Scan, sdf: SDF, place: Similarity, noise: float) -> float:
    """Of the rays that pass the unit sphere before their end, the share that passes through the shape.

    `noise`, in radii of the unit sphere, is that of their ends.
    """
    rays = place.rays_in_object(scan.free)
    bounds = meet_sphere(rays)
    far = bounds.far.minimum(scan.free_until / place.scale - noise - BLOCKED)
    passing = bounds.near < far
    if not passing.any():
        return 0.0
    chosen = passing.nonzero()[:, 0]
    chosen = chosen[:: -(-len(chosen) // MOST_RAYS)]
    rays = rays[chosen]
    near, far = bounds.near[chosen], far[chosen]
    trace = sphere_trace(sdf, rays, Bounds(near, far), TraceConfig(coarse_levels=0))
    return float(trace.hit.float().mean())
