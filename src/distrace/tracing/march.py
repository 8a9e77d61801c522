"""Marching without gradients: cones of blocks of pixels, then single rays in lock step up to their first root."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from distrace.tracing.images import Lines

Values = Callable[[Lines, Float[Tensor, "*k n"]], Float[Tensor, "*k n"]]
NEVER = 1e3  # radii: farther than any place on a ray
PATIENCE = 6  # a look is at √(looks so far × all rays ÷ (PATIENCE × rays left)) places of each ray


class State(NamedTuple):
    """What is known of rays, in radii. Each is clear up to `t`, but for gaps. The last four stay as they are."""

    t: Float[Tensor, "n"]
    value: Float[Tensor, "n"]  # of f at t; NEVER if that is not known
    at: Float[Tensor, "n"]  # where f is looked at next; when the ray is done, where it is hit, or beyond `far`
    high: Float[Tensor, "n"]  # the nearest point inside
    least: Float[Tensor, "n"]  # f so far …
    closest: Float[Tensor, "n"]  # … and where that was
    looks: Float[Tensor, "n"]  # evaluations of f
    done: Float[Tensor, "n"]  # 0 until nothing more is to be looked at
    far: Float[Tensor, "n"]  # beyond there is no surface
    gap: Float[Tensor, "n"]  # half of what the balls around two samples may leave between them
    tolerance: Float[Tensor, "n"]  # how far off a hit may be …
    bracket: Float[Tensor, "n"]  # … and in how short a bracket the root of the line is taken

    @staticmethod
    def of_spans(t: Float[Tensor, "n"], *known: Float[Tensor, "n"]) -> "State":
        """Of rays that are clear before t, with what stays as it is."""
        zero, never = torch.zeros_like(t), torch.full_like(t, NEVER)
        return State(t, never, t, never, never, t, zero, zero, *known)


CHANGING = State._fields.index("far")  # of the facts, so many


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
    zero = span.new_zeros(())
    for _ in range(looks):
        clear = torch.fmax(values(lines, t) - error, zero)  # also where f is NaN
        radius = torch.addcmul(width, growth, t + clear)
        t = t + torch.addcmul(clear * clear, radius, radius, value=-1).clamp_min(0).sqrt()
    return torch.stack([t, far, begin])


def march(
    values: Values,
    lines: Lines,
    states: Float[Tensor, "12 n"],
    active: Int[Tensor, "m"],
    looks: int,
    error: float | None = None,
) -> None:
    """Looks at the active rays in lock step, and writes what became of them to `states`.

    When few rays are left each is looked at in several places at once. Values that are good to an `error` never decide
    on a hit: rays where f is no greater are left alone, and each is looked at in one place.
    """
    changing = states[:CHANGING]
    for number in range(looks):
        if not len(active):
            break
        some, state = lines[active], State(*states.index_select(1, active).unbind(0))
        probes = math.isqrt(states.shape[1] * number // (PATIENCE * len(active)))
        if probes < 2 or error is not None:
            found, _, done = _advanced(state._replace(looks=state.looks + 1), values(some, state.at), error)
        else:
            found = _first(state, values, some, probes)
            done = found[CHANGING - 1] > 0
        changing.index_copy_(1, active, found)
        active = active[~done]


def _first(state: State, values: Values, lines: Lines, probes: int) -> Float[Tensor, "8 n"]:
    """Looks ahead in several places, and tells what is known after the first that the ray may not pass."""
    end = state.at.minimum(state.t.lerp(state.high, 1 / (probes + 1)))
    order = torch.arange(probes + 1, dtype=end.dtype, device=end.device)[:, None]
    along = torch.lerp(state.t, end, order)
    at = along[1:]
    after = values(lines, at)
    before = torch.cat([state.value[None], after[:-1]])
    looks = (state.looks + probes).expand_as(after)
    found, clear, _ = _advanced(state._replace(t=along[:-1], value=before, at=at, looks=looks), after, None)
    passes = clear & (2 * after > before)  # the line has no root before the next place
    first = F.pad(passes[:-1].to(torch.uint8), (0, 0, 0, 1)).argmin(0)
    return found.gather(1, first.expand(CHANGING, 1, -1))[:, 0]


def _advanced(
    state: State, after: Float[Tensor, "*k n"], error: float | None
) -> tuple[Float[Tensor, "8 *k n"], Bool[Tensor, "*k n"], Bool[Tensor, "*k n"]]:
    """What is known after f was looked at, of all that changes; which steps count, and which rays are done.

    A step counts if the balls around its ends leave no more than the gap between them. The next one ends at the nearest
    of these: the root of the line through the last two values (by exact values, in the middle of where f counts as a
    hit, just before); where the balls around its ends, by the slope, leave half the gap; the middle of the bracket that
    was known before, or of a step that did not count. A ray is hit where f, outside, is too small for the line's root
    to be none, or in a short bracket.
    """
    t, before, at, high, least, closest, looks, _, far, gap, tolerance, bracket = state
    step = (at - t).clamp_min(1e-12)  # an exact look may lie before a rough one
    covered = torch.add(before + after, gap, alpha=2) >= step
    inside = after <= (error or 0.0)
    clear = covered > inside
    moved, value = torch.where(clear, at, t), torch.where(clear, after, before)
    slope = ((before - after) / step).clamp(1e-6, 1)  # downwards
    root = torch.addcdiv(at, after, slope)
    aim = torch.addcmul(root, tolerance, slope, value=-0.5) if error is None else root
    balls = torch.addcdiv(at, torch.add(gap, after, alpha=2), slope + 1)
    middle = torch.lerp(moved, torch.where(covered, high, at), 0.5)
    following = torch.minimum(torch.minimum(aim, balls), middle)
    if error is None:
        high = torch.where(inside, at, high)
        done = (value < tolerance * slope * slope) | (moved >= torch.minimum(high - bracket, far))
        following = torch.where(done, torch.minimum(root, high), following)
    else:
        done = inside | (moved >= far)
    closest, least = torch.where(after < least, at, closest), torch.minimum(after, least)
    return torch.stack([moved, value, following, high, least, closest, looks, done]), clear, done
