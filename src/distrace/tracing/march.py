"""Marching without gradients: cones of blocks of pixels, then single rays in lock step up to their first root."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.tracing.images import Lines

Values = Callable[[Lines, Float[Tensor, "*k n"]], Float[Tensor, "*k n"]]
UNKNOWN = 1e3  # radii: the value at a start that was not looked at
BRACKET = 8.0  # tolerances: in a shorter one the root of the line is taken
PATIENCE = 8  # looks after which a ray is looked at in as many places at once as the root of the rays per ray left


class State(NamedTuple):
    """What is known of rays, in radii. Each is clear up to `t`, but for gaps."""

    t: Float[Tensor, "n"]
    value: Float[Tensor, "n"]  # of f at t
    at: Float[Tensor, "n"]  # where f is looked at next
    high: Float[Tensor, "n"]  # the nearest point inside; infinite while there is none
    far: Float[Tensor, "n"]  # beyond there is no surface
    least: Float[Tensor, "n"]  # f so far …
    closest: Float[Tensor, "n"]  # … and where that was
    hit: Float[Tensor, "n"]  # NaN until there is one
    looks: Float[Tensor, "n"]  # evaluations of f

    @staticmethod
    def of_spans(t: Float[Tensor, "n"], far: Float[Tensor, "n"]) -> "State":
        """Of rays that are clear before t."""
        never, zero = torch.full_like(t, torch.inf), torch.zeros_like(t)
        return State(t, zero + UNKNOWN, t, never, far, never, t, never * 0, zero)


def march_cones(
    values: Values,
    lines: Lines,
    span: Float[Tensor, "3 n"],
    width: Float[Tensor, "#n"],
    growth: Float[Tensor, "#n"],
    looks: int,
    error: float,
) -> Float[Tensor, "3 n"]:
    """Moves each block's cone on while the ball around its middle ray that f keeps clear covers the cone.

    `span` tells from where and up to where a cone may see surface, where it began. Its radius is width + growth · t.
    A ball of radius r at t covers the cone up to t + √(r² − ρ²), where ρ is its radius at t + r at the farthest. Values
    are good to an `error`, which is taken off.
    """
    t, far, begin = span.unbind(0)
    for _ in range(looks):
        clear = (values(lines, t) - error).clamp_min(0)
        radius = torch.addcmul(width, growth, t + clear)
        t = t + torch.addcmul(clear * clear, radius, radius, value=-1).clamp_min(0).sqrt()
    return torch.stack([t, far, begin])


def march(
    values: Values,
    lines: Lines,
    states: Float[Tensor, "9 n"],
    active: Int[Tensor, "m"],
    looks: int,
    gap: Float[Tensor, "views"],
    tolerance: Float[Tensor, "views"],
    error: float | None = None,
) -> Int[Tensor, "left"]:
    """Looks at the active rays in lock step; writes what became of them to `states`, returns those without a result.

    A step ends before the root of the line through the last two values, in the middle of where f counts as a hit, or
    where the balls around its ends, by the slope, leave half a gap between them; it counts if they leave no more than
    the gap. In a bracket it is no longer than half. A ray is hit where f, outside, is too small for the line's root to
    be none, or in a short bracket. When few rays are left each is looked at in several places at once. Values that are
    good to an `error` never decide on a hit: rays where f is no greater are left alone.
    """
    zero, half, short = error or 0.0, gap / 2, BRACKET * tolerance
    for number in range(looks):
        if not len(active):
            break
        some = lines[active]
        state = State(*states.index_select(1, active).unbind(0))
        allowed = some.of_view(gap)
        probes = max(1, math.isqrt(states.shape[1] * number // (PATIENCE * len(active))))
        t, before, after, at = _looked(values, some, state, probes, allowed, zero)
        step = (at - t).clamp_min(1e-7)  # an exact look may lie before a rough one
        covered = before + after + allowed >= step
        clear = covered & (after > zero)
        crossed = after <= -zero
        known = covered | crossed
        moved, value = torch.where(clear, at, t), torch.where(clear, after, before)
        falling = ((after - before) / step).clamp(-1, -1e-6)
        level = some.of_view(tolerance) * falling * falling
        root = torch.addcdiv(at, after, falling, value=-1)
        aim = torch.addcdiv(at, torch.sub(after, level, alpha=0.5), falling, value=-1)
        balls = torch.addcdiv(at, torch.add(some.of_view(half), after, alpha=2), 1 - falling)
        onward = torch.minimum(torch.minimum(aim, balls), (moved + state.high) / 2)
        following = torch.where(known, onward, moved + value + allowed)
        high = torch.where(crossed, at, state.high)
        going, hit = moved < state.far, state.hit
        if error is None:
            seen = before < UNKNOWN
            found = ((value < level) | (crossed & (step < some.of_view(short)))) & seen
            hit = torch.where(found, torch.minimum(root, high), hit)
            going = (going > found) & (clear | seen)
        else:
            going = going & (clear | ~known)
        closest, least = torch.where(after < state.least, at, state.closest), torch.minimum(after, state.least)
        new = State(moved, value, following, high, state.far, least, closest, hit, state.looks + probes)
        states.index_copy_(1, active, torch.stack(new))
        active = active.index_select(0, going.nonzero()[:, 0])
    return active


def _looked(
    values: Values, lines: Lines, state: State, probes: int, gap: Float[Tensor, "#n"], zero: float
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Two neighbouring samples of each ray, t, f(t), f(t') and t': the first pair of those that may not be passed."""
    if probes == 1:
        return state.t, state.value, values(lines, state.at), state.at
    step = torch.minimum(state.at - state.t, (state.high - state.t) / (probes + 1))
    order = torch.arange(probes + 1, dtype=step.dtype, device=step.device)[:, None]
    along = torch.addcmul(state.t, order, step)
    ahead = torch.cat([state.value[None], values(lines, along[1:])])
    before, after = ahead[:-1], ahead[1:]
    outside = after > zero
    passes = outside & (before + after + gap >= step)
    passes[:-1].logical_and_((2 * after > before)[:-1] | ~outside[1:])  # not where the line has a root before the next
    first = passes.long().cumprod(0).sum(0, keepdim=True).clamp_max(probes - 1)
    pair = torch.cat([first, first + 1])
    t, at = along.gather(0, pair).unbind(0)
    before, after = ahead.gather(0, pair).unbind(0)
    return t, before, after, at
