"""DIST's own gradient of a distance, for comparison: biased, where `surface.attach` is exact."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.base import SDF
from distrace.rays import Bounds, Rays
from distrace.tracing.sphere_tracing import AGGRESSIVE, TraceConfig


@dataclass(frozen=True)
class Queries:
    """Where a march ended, and where it asked last."""

    distance: Float[Tensor, "*batch"]  # `inf` without a hit
    last: Float[Tensor, "queries *batch"]  # the latest last; NaN where a ray had fewer
    config: TraceConfig


@torch.no_grad()
def march(sdf: SDF, rays: Rays, bounds: Bounds, config: TraceConfig = AGGRESSIVE, queries: int = 5) -> Queries:
    """DIST's plain march, t ← t + α · f, that keeps its last queries (the original's demo 3, its default 5).

    Raises `ValueError` for fewer than one query.
    """
    if queries < 1:
        raise ValueError(f"the last {queries} queries were asked for; DIST's gradient needs at least 1")
    flat, far = rays.detach().flat(), bounds.far.reshape(-1)
    t = bounds.near.reshape(-1).clone()
    distance = torch.full_like(t, torch.inf)
    last = torch.full_like(t, torch.nan).repeat(queries, 1)
    active = (t < far).nonzero()[:, 0]
    for _ in range(config.steps):
        value = sdf(flat[active].at(t[active]))
        last[:, active] = torch.cat([last[1:, active], t[None, active]])
        t[active] += _step(value, config)
        converged = value.abs() < config.tolerance
        distance[active[converged]] = t[active[converged]]
        active = active[~converged & (t[active] < far[active])]
    return Queries(distance.reshape(rays.shape), last.reshape(queries, *rays.shape), config)


def attach_dist(sdf: SDF, rays: Rays, marched: Queries, queries: int | None = None) -> Float[Tensor, "*batch"]:
    """The distances of a march, with the derivative of d = α Σ f(p⁽ⁿ⁾) over the last queries at fixed distances.

    It drops how each p⁽ⁿ⁾ depends on the queries before (Liu et al., CVPR 2020, section 3.3), and counts the surface's
    motion once per query: on a sphere it is wrong by a factor of α · queries · cos θ, at an angle θ to the normal.
    """
    hit = marched.distance.isfinite()
    last = marched.last[-queries:] if queries else marched.last
    asked = last.isfinite() & hit
    fixed = Rays(rays.origins.expand(*last.shape, 3)[asked], rays.directions.expand(*last.shape, 3)[asked])
    steps = _step(sdf(fixed.at(last[asked])), marched.config)
    moved = torch.zeros_like(last).masked_scatter(asked, steps - steps.detach()).sum(0)
    return marched.distance + moved


def _step(value: Tensor, config: TraceConfig) -> Tensor:
    return config.step_scale * value.clamp(-config.step_limit, config.step_limit)
