"""Which of several completions contradicts least what was seen: all rays count, none for more than it can tell."""

import torch

from distrace.fields.batch import BatchField
from distrace.fitting.noise_estimation import expected
from distrace.fitting.observations import Seen
from distrace.metrics import iou
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace

MOST = 0.1  # a depth that is off by more is as wrong as one that is missed, and so is a ray of the silhouette


@torch.no_grad()
def contradictions(field: BatchField, seen: Seen, config: TraceConfig) -> list[float]:
    """How far each surface is from the depths, in the mean; and, × `MOST`, the share of rays that it meets wrongly.

    Noisy depths are off the true surface, too: what that makes is left out, so that a good fit to them is one.
    The share is of those that meet it or the object: one less their intersection over union. A fit's own loss tells
    worse which fit is good: it takes distances from the slope of the field, which are too large where rays graze the
    surface, and a single ray that misses a wing outweighs a hundred others.
    """
    rays = torch.arange(len(seen.observed), device=seen.observed.device)
    shape = torch.arange(len(field), device=rays.device).repeat_interleave(len(rays))
    every, known = seen[rays.repeat(len(field))], seen.known
    trace = sphere_trace(field.select(shape), every.rays, every.bounds, config).reshaped(torch.Size([len(field), -1]))
    deviation = (trace.distance - seen.observed).abs().clamp_max(MOST).masked_fill(~trace.hit, MOST)
    beyond = (deviation - expected(seen.noise, MOST))[:, known].sum(1) / max(int(known.sum()), 1)
    return [float(depth) + MOST * (1 - iou(hit, seen.is_object)) for depth, hit in zip(beyond, trace.hit, strict=True)]
