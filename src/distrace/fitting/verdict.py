"""Which of several completions contradicts least what was seen: all rays count, none for more than it can tell."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.batch_field import BatchField
from distrace.field import SDF
from distrace.fitting.noise_level import expected
from distrace.fitting.seen import Seen
from distrace.metrics import iou
from distrace.trace import TraceConfig, sphere_trace

MOST = 0.1  # a depth that is off by more is as wrong as one that is missed, and so is a ray of the silhouette


@torch.no_grad()
def contradiction(sdf: SDF, seen: Seen, config: TraceConfig) -> float:
    """How far a surface is from the depths, in the mean; and, × `MOST`, the share of rays that it meets wrongly.

    Noisy depths are off the true surface, too: what that makes is left out, so that a good fit to them is one.
    The share is of those that meet it or the object: one less their intersection over union. A fit's own loss tells
    worse which fit is good: it takes distances from the slope of the field, which are too large where rays graze the
    surface, and a single ray that misses a wing outweighs a hundred others.
    """
    trace = sphere_trace(sdf, seen.rays, seen.bounds, config)
    return _contradiction(trace.distance, trace.hit, seen)


@torch.no_grad()
def contradictions(field: BatchField, seen: Seen, config: TraceConfig) -> list[float]:
    """That of each shape's surface, all of them traced together."""
    rays = torch.arange(len(seen.observed), device=seen.observed.device)
    shape = torch.arange(len(field), device=rays.device).repeat_interleave(len(rays))
    every = seen[rays.repeat(len(field))]
    trace = sphere_trace(field.select(shape), every.rays, every.bounds, config)
    each = zip(trace.distance.reshape(len(field), -1), trace.hit.reshape(len(field), -1), strict=True)
    return [_contradiction(distance, hit, seen) for distance, hit in each]


def _contradiction(distance: Float[Tensor, "n"], hit: Bool[Tensor, "n"], seen: Seen) -> float:
    deviation = (distance - seen.observed).abs().clamp_max(MOST).masked_fill(~hit, MOST)
    beyond = (deviation - expected(seen.noise, MOST))[seen.known]
    depth = beyond.sum() / max(int(seen.known.sum()), 1)
    return float(depth) + MOST * (1 - iou(hit, seen.is_object))
