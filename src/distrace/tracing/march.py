"""Marching without gradients: cones of blocks of pixels, then single rays in lock step up to their first root."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from distrace.tracing.images import Lines

Values = Callable[[Lines, Float[Tensor, "*k n"]], Float[Tensor, "*k n"]]
Schedule = tuple[tuple[int, ...], ...]
"""The samples of each ray in each query; the active rays are compacted after each group."""
CONES = 5  # queries of the cones of one size
ROUGH: Schedule = ((1, 1), (2, 3))  # of single rays by bfloat16 values …
EXACT: Schedule = ((1,), (1,), (4,), (8,), (16,), (32,), *[(256,)] * 42)  # … and then by exact ones; some graze
EXACT_ALONE: Schedule = (*[(1,)] * 4, *[(2,)] * 2, *[(4,)] * 2, (8,), (16,), (32,), *[(256,)] * 37)  # by exact ones
BRACKET = 2  # tolerances: in a shorter bracket the secant's root is the hit
OVERSHOOT = 0.1  # tolerances behind a root, for the next query: only a point inside ends a ray
FLAT = torch.tensor(1e-6)  # the least slope, so that secants have a root
Queried = tuple[Int[Tensor, "_"], int]
"""Rays that were queried together, and the number of samples of each."""


class State(NamedTuple):
    """The state of rays, in radii. Each is clear up to `t`, but for gaps. The last two fields are constant."""

    t: Float[Tensor, "*k n"]
    value: Float[Tensor, "*k n"]  # of f at t
    at: Float[Tensor, "*k n"]  # the distance of the next query
    root: Float[Tensor, "*k n"]  # of the secant through the last two values
    end: Float[Tensor, "n"]  # of the ray: beyond is no surface or, after a bracket, a point inside
    least: Float[Tensor, "n"]  # value so far …
    closest: Float[Tensor, "n"]  # … and its distance
    gap: Float[Tensor, "n"]  # half of the distance that the balls around two samples may leave between them
    tolerance: Float[Tensor, "n"]  # the largest error of a hit

    @staticmethod
    def begin(
        values: Values,
        lines: Lines,
        t: Float[Tensor, "n"],
        end: Float[Tensor, "n"],
        gap: Float[Tensor, "n"],
        tolerance: Float[Tensor, "n"],
    ) -> "State":
        """Returns the state of rays that are clear before t and beyond an end, from one query at t."""
        value = values(lines, t)
        at = torch.minimum(t + value.maximum(tolerance), end)  # t may be on the surface
        return State(t, value, at, at, end, value, t, gap, tolerance)


PER_SAMPLE = State._fields.index("end")  # the number of rows that belong to one sample …
CHANGING = State._fields.index("gap")  # … and of those that change


def march_cones(
    values: Values, lines: Lines, span: Float[Tensor, "3 n"], radius: Float[Tensor, "n"], error: float
) -> Float[Tensor, "3 n"]:
    """Advances each block's cone while the clear ball around its middle ray covers the cone.

    `span`: the begin and the end of a cone's possible surface, and the begin of its march; `radius`: the cone's at the
    end. A ball of radius r covers a cone of radius ρ for √(r² − ρ²) from its centre. Values are good to an `error`.
    """
    t, far, begin = span.unbind(0)
    zero = span.new_zeros(())
    minus_square = -radius.square()
    for _ in range(CONES):
        clear = torch.fmax(values(lines, t) - error, zero)  # also where f is NaN
        t = t + torch.addcmul(minus_square, clear, clear).clamp_min(0).sqrt()
    return torch.stack([t, far, begin])


def march(
    values: Values,
    lines: Lines,
    states: Float[Tensor, "9 n"],
    active: Int[Tensor, "m"],
    schedule: Schedule,
    error: float | None = None,
) -> list[Queried]:
    """Marches the active rays in lock step until they are done, and writes their states to `states`.

    Values that are good to an `error` never decide on a hit: they drop a ray that a query does not advance.
    """
    changing = states[:CHANGING]
    queried: list[Queried] = []
    for group in schedule:
        if not len(active):
            break
        lines_active = lines[active]
        last = State(*states.index_select(1, active).unbind(0))
        for samples in group[:-1]:
            last = _query(last, values, lines_active, samples, error)
        state = _query(last, values, lines_active, group[-1], error)
        changing.index_copy_(1, active, torch.stack(state[:CHANGING]))
        queried.append((active, sum(group)))
        marching = state.t < state.end
        active = active[marching if error is None else marching & (state.t > last.t)]
    return queried


def evaluations(queried: list[Queried], count: int) -> Shaped[Tensor, "n"]:
    """Returns the number of evaluations of f for each of `count` rays."""
    rays = torch.cat([ray for ray, _ in queried])
    lengths, samples = torch.tensor([(len(ray), samples) for ray, samples in queried], device=rays.device).unbind(1)
    return rays.bincount(samples.repeat_interleave(lengths), count)


def _query(state: State, values: Values, lines: Lines, samples: int, error: float | None) -> State:
    """Queries samples ahead, at multiples of one step, and returns the state at the first sample to stop at.

    They fill the rest of a short ray evenly; the last may lie beyond its end. A ray stops where f fell below half of
    its value: the secant would have a root before the next sample.
    """
    if samples == 1:
        lowest = values(lines, state.at)
        where = state.at
        following, _, _ = _advanced(state, lowest, error)
    else:
        order = _order(samples, state.t.dtype, state.t.device)
        spread = state.t.lerp(state.end, 1 / (samples - 0.5))
        first = state.at.minimum(spread).maximum(state.t + state.tolerance)
        along = torch.lerp(state.t, first, order)
        at = along[1:]
        after = values(lines, at)
        before = torch.cat([state.value[None], after[:-1]])
        following, clear, drop = _advanced(state._replace(t=along[:-1], value=before, at=at), after, error)
        passed = (clear & (drop < after))[:-1].cumprod(0).sum(0)
        ray = torch.arange(len(passed), device=passed.device)
        at_stop = torch.stack(following[:PER_SAMPLE])[:, passed, ray].unbind(0)
        following = State(*at_stop, *following[PER_SAMPLE:])
        lowest, place = after.masked_fill(at > state.end, torch.inf).min(0)
        where = at[place, ray]
    closest = torch.where(lowest < state.least, where, state.closest)
    return following._replace(least=torch.fmin(lowest, state.least), closest=closest)


@lru_cache
def _order(samples: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "k 1"]:
    """Returns 0 … samples; cached, as it serves every query."""
    return torch.arange(samples + 1, dtype=dtype, device=device)[:, None]


def _advanced(
    state: State, after: Float[Tensor, "*k n"], error: float | None
) -> tuple[State, Bool[Tensor, "*k n"], Float[Tensor, "*k n"]]:
    """Returns the state after a query, which steps are clear, and by how much f fell.

    A step is clear if the balls around its ends leave no more than the gap between them. The next one ends at the
    nearest of: the secant's root; the point at which the balls, by the slope, leave half the gap; the end of the ray,
    or the middle of a step that was not clear. A ray ends a bracket before a point inside, unless that is, by the
    slope, within the tolerance of the surface.
    """
    t, before, at, _, end, *_, gap, tolerance = state
    step, drop = at - t, before - after
    slope = torch.fmax(drop / step, FLAT)  # also where f is NaN, or the step zero
    uncovered = torch.sub(step - before, gap, alpha=2)  # the part of the step for the ball around `after`
    covered = after > uncovered
    if error is None:
        clear = covered & (torch.addcmul(after, tolerance, slope) > 0)
        end = torch.where(after < 0, torch.sub(at, tolerance, alpha=BRACKET), end)
        end = end.amin(0) if after.dim() > 1 else end
    else:
        clear = after > uncovered.clamp_min(error)
    root = torch.addcdiv(at, after, slope)
    balls = torch.addcdiv(at, torch.add(gap, after, alpha=2), slope + 1)
    limit = torch.where(covered, end, t.lerp(at, 0.5))
    inside = torch.add(root, tolerance, alpha=OVERSHOOT)
    following = torch.fmin(torch.fmin(inside, balls), limit)
    advanced = torch.where(clear, at, t)
    value = torch.where(clear, after, before)
    return state._replace(t=advanced, value=value, at=following, root=root, end=end), clear, drop
