"""Coarse-to-fine starts: one coarse ray marches for the pixels around it (Liu et al., CVPR 2020, section 3.1)."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.fields.base import SDF
from distrace.rays import meet_sphere
from distrace.tracing.sphere_tracing import Outcome, TraceConfig, sphere_trace


@torch.no_grad()
def starts(
    sdf: SDF, camera: Camera, radius: float, config: TraceConfig
) -> tuple[Float[Tensor, "*batch height width"], int]:
    """Returns distances at which the rays of an image may start, and the evaluations that this took.

    Each level marches `coarse_steps` and gives its distances to four rays each. A coarse ray stops where the surface is
    nearer than its pixel is wide, as its neighbours may hit it. A ray that left the bounds gives none. Depth is never
    taken from a coarse ray.
    """
    start = None
    evaluations = 0
    for level in range(config.coarse_levels, 0, -1):
        coarse = camera.resized(0.5**level)
        rays = coarse.rays()
        bounds = meet_sphere(rays, radius)
        reach = 2**0.5 * coarse.tolerance(1.0) * bounds.far  # half the diagonal of a pixel, where it is widest
        few = replace(config, steps=config.coarse_steps, tolerance=reach.clamp_min(0), polish=False)
        trace = sphere_trace(sdf, rays, bounds, few, None if start is None else _split(start, coarse))
        lost = (trace.outcome == Outcome.ESCAPED) | (trace.outcome == Outcome.INSIDE)
        start = torch.where(lost, -torch.inf, trace.stopped - reach)
        evaluations += trace.total_evaluations
    assert start is not None
    return _split(start, camera), evaluations


def _split(distance: Float[Tensor, "*batch h w"], camera: Camera) -> Float[Tensor, "*batch height width"]:
    fine = distance.repeat_interleave(2, dim=-1).repeat_interleave(2, dim=-2)
    return fine[..., : camera.height, : camera.width]
