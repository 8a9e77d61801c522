"""DIST's own gradient of a distance, for comparison: it is biased, while `surface.attach` is exact."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.base import SDF
from distrace.rays import Bounds, Rays
from distrace.tracing.sphere_tracing import AGGRESSIVE


@dataclass(frozen=True)
class Marched:
    """The hits of a march, and the distances of its last queries."""

    distance: Float[Tensor, "*batch"]  # `inf` without a hit
    last: Float[Tensor, "queries *batch"]  # in the order of the march; NaN where a ray had fewer


@torch.no_grad()
def march(sdf: SDF, rays: Rays, bounds: Bounds, queries: int = 5) -> Marched:
    """Runs DIST's march t ← t + α · f, and returns the last `queries` distances (DIST's default is 5).

    Raises `ValueError` for fewer than one query.
    """
    if queries < 1:
        raise ValueError(f"the last {queries} queries were given; DIST's gradient needs at least 1")
    flat = rays.detach().flat()
    far = bounds.far.reshape(-1)
    t = bounds.near.reshape(-1).clone()
    distance = torch.full_like(t, torch.inf)
    last = torch.full_like(t, torch.nan).repeat(queries, 1)
    active = (t < far).nonzero()[:, 0]
    for _ in range(AGGRESSIVE.steps):
        value = sdf(flat[active].at(t[active]))
        last[:, active] = torch.cat([last[1:, active], t[None, active]])
        t[active] += _step(value)
        converged = value.abs() < AGGRESSIVE.tolerance
        distance[active[converged]] = t[active[converged]]
        active = active[~converged & (t[active] < far[active])]
    return Marched(distance.reshape(rays.shape), last.reshape(queries, *rays.shape))


def attach_dist(sdf: SDF, rays: Rays, marched: Marched, queries: int) -> Float[Tensor, "*batch"]:
    """Returns the distances of a march, with the derivative of d = α Σ f(p⁽ⁿ⁾) over the last queries.

    The points p⁽ⁿ⁾ are held fixed (Liu et al., CVPR 2020, section 3.3), so the surface's motion counts once per
    query. On a sphere the derivative is off by the factor α · queries · cos θ, where θ is the angle to the normal.
    """
    last = marched.last[-queries:]
    queried = last.isfinite() & marched.distance.isfinite()
    fixed = Rays(rays.origins.expand(*last.shape, 3)[queried], rays.directions.expand(*last.shape, 3)[queried])
    steps = _step(sdf(fixed.at(last[queried])))
    return marched.distance + torch.zeros_like(last).masked_scatter(queried, steps - steps.detach()).sum(0)


def _step(value: Tensor) -> Tensor:
    return AGGRESSIVE.step_scale * value.clamp(-AGGRESSIVE.step_limit, AGGRESSIVE.step_limit)
