"""Roots of f along rays by exact values: Newton's step, secants, and a bracket once the sign has changed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.tracing.batch import Batch
from distrace.tracing.evaluator import Evaluator
from distrace.tracing.march import Roots

SURE = 0.3  # slope at which a value near zero is a root also without a change of sign
LEVEL_SLOPE = 0.02  # flatter slopes are no slopes of roots
SECANT_ERROR = 0.1  # relative error of the slope between two samples around a root
FARTHEST = 3.0  # pixels between a predicted root and the root: what is farther is another surface
ZERO = 0.4  # of the tolerance: so small are values at roots that are taken without a change of sign


@dataclass(frozen=True)
class Found:
    """The root of each ray, NaN where none was found, and up to where that ray is known to be outside."""

    t: Float[Tensor, "n"]
    clear: Float[Tensor, "n"]
    evaluations: Int[Tensor, "n"]


def refine(
    evaluator: Evaluator, batch: Batch, roots: Roots, tolerance: float, looks: int, *, settle: bool = True
) -> Found:
    """Evaluates f at predicted roots and steps to the zero of the line through them, until it is close enough.

    A step of length s by a secant ends within `SECANT_ERROR` · s of the root. Without a change of sign only a steep
    slope and a value near zero tell that there is a root. With `settle` a bracket after the last look is a root, too.
    """
    t = torch.full_like(roots.t, torch.nan)
    clear = roots.low.clone()
    evaluations = torch.zeros_like(roots.ray)
    active = torch.arange(len(t), device=t.device)
    some = batch[roots.ray]
    farthest = FARTHEST * some.pixel(roots.t)
    nothing = torch.full_like(t, torch.nan)
    state = torch.stack([roots.t, roots.slope, roots.low, roots.high, nothing, nothing, farthest], dim=1)
    for look in range(looks):
        at, slope, low, high, last, last_value, farthest = state.unbind(1)
        value = evaluator.exact(some, at)
        inside = value <= 0  # a root that is met exactly is a bracket, too
        low = torch.where(inside, low, at)
        high = torch.where(inside, at, high)
        bracketed = high < torch.inf
        secant = (value - last_value) / (at - last)
        usable = secant < -LEVEL_SLOPE
        slope = torch.where(usable, secant, slope)
        step = -value / slope.clamp_max(-LEVEL_SLOPE)
        following = at + step
        stays = ~bracketed | ((following >= low) & (following <= high))
        following = torch.where(stays, following, (low + high) / 2)
        close = stays & (step.abs() < tolerance) & (value.abs() < ZERO * tolerance) & (bracketed | (slope < -SURE))
        closed = bracketed & usable & stays & (SECANT_ERROR * step.abs() < tolerance)
        done = close | closed | (high - low < tolerance)
        if settle and look == looks - 1:
            done = done | bracketed
        t[active] = torch.where(done, following, torch.nan)
        clear[active] = low
        evaluations[active] += 1
        rising = ~bracketed & (secant >= -LEVEL_SLOPE)
        go = (~done & ~rising & (bracketed | (step.abs() < farthest))).nonzero()[:, 0]
        if not len(go):
            break
        state = torch.stack([following, slope, low, high, at, value, farthest], dim=1)[go]
        active, some = active[go], some[go]
    return Found(t, clear, evaluations)
