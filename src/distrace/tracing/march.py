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
"""How many samples of each ray a query takes, query by query; after each group the active rays are compacted."""
CONES = 5  # queries of the cones of one size
ROUGH: Schedule = ((1, 1), (2, 3))  # of single rays by rough values …
EXACT: Schedule = ((1,), (1,), (4,), (8,), (16,), (32,), *[(256,)] * 42)  # … and by exact ones after these: some graze
EXACT_ALONE: Schedule = (*[(1,)] * 4, *[(2,)] * 2, *[(4,)] * 2, (8,), (16,), (32,), *[(256,)] * 37)  # by these alone
BRACKET = 2  # tolerances: in a shorter bracket the root of the line is taken
OVERSHOOT = 0.1  # tolerances that a query aims behind a root: only a point inside ends a ray
FLAT = torch.tensor(1e-6)  # no slope is less, so that lines have a root
Queried = tuple[Int[Tensor, "_"], int]
"""Rays that were queried together, and how many samples of each."""


class State(NamedTuple):
    """What is known of rays, in radii. Each is clear up to `t`, but for gaps. The last two stay as they are."""

    t: Float[Tensor, "*k n"]
    value: Float[Tensor, "*k n"]  # of f at t
    at: Float[Tensor, "*k n"]  # where f is queried next
    root: Float[Tensor, "*k n"]  # of the line through the last two values
    end: Float[Tensor, "n"]  # where the ray is done: beyond is no surface or, after a bracket, a point inside
    least: Float[Tensor, "n"]  # f so far …
    closest: Float[Tensor, "n"]  # … and where that was
    gap: Float[Tensor, "n"]  # half of what the balls around two samples may leave between them
    tolerance: Float[Tensor, "n"]  # how far off a hit may be

    @staticmethod
    def begun(
        values: Values,
        lines: Lines,
        t: Float[Tensor, "n"],
        end: Float[Tensor, "n"],
        gap: Float[Tensor, "n"],
        tolerance: Float[Tensor, "n"],
    ) -> "State":
        """The state of rays that are clear before t and beyond an end, from one query at t."""
        value = values(lines, t)
        at = torch.minimum(t + value.maximum(tolerance), end)  # t may be on the surface
        return State(t, value, at, at, end, value, t, gap, tolerance)


PLACED = State._fields.index("end")  # so many rows belong to one sample …
CHANGING = State._fields.index("gap")  # … and so many change


def march_cones(
    values: Values, lines: Lines, span: Float[Tensor, "3 n"], radius: Float[Tensor, "n"], error: float
) -> Float[Tensor, "3 n"]:
    """Moves each block's cone on while the ball around its middle ray that f keeps clear covers the cone.

    `span` tells from where and up to where a cone may see surface, where it began; `radius` is the cone's at the end. A
    ball of radius r covers a cone of radius ρ for √(r² − ρ²) from its middle. Values are good to an `error`, which is
    taken off.
    """
    t, far, begin = span.unbind(0)
    zero, less = span.new_zeros(()), -radius.square()
    for _ in range(CONES):
        clear = torch.fmax(values(lines, t) - error, zero)  # also where f is NaN
        t = t + torch.addcmul(less, clear, clear).clamp_min(0).sqrt()
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

    Values that are good to an `error` never decide on a hit: a ray that a query does not advance is left alone.
    """
    changing = states[:CHANGING]
    queried = []
    for group in schedule:
        if not len(active):
            break
        some, last = lines[active], State(*states.index_select(1, active).unbind(0))
        for samples in group[:-1]:
            last = _query(last, values, some, samples, error)
        state = _query(last, values, some, group[-1], error)
        changing.index_copy_(1, active, torch.stack(state[:CHANGING]))
        queried.append((active, sum(group)))
        going = state.t < state.end
        active = active[going if error is None else going & (state.t > last.t)]
    return queried


def evaluations(queried: list[Queried], count: int) -> Shaped[Tensor, "n"]:
    """How often f was evaluated for each of so many rays."""
    rays = torch.cat([ray for ray, _ in queried])
    lengths, samples = torch.tensor([(len(ray), samples) for ray, samples in queried], device=rays.device).unbind(1)
    return rays.bincount(samples.repeat_interleave(lengths), count)


def _query(state: State, values: Values, lines: Lines, samples: int, error: float | None) -> State:
    """Queries several samples ahead, as far apart as one would be, and returns the state at the first to stop at.

    They fill the rest of the ray evenly where that is short; the last may lie beyond its end. A ray stops where f fell
    below half of what it was: the line would have a root before the next sample.
    """
    if samples == 1:
        lowest = values(lines, state.at)
        where = state.at
        found, _, _ = _advanced(state, lowest, error)
    else:
        order = _order(samples, state.t.dtype, state.t.device)
        spread = state.t.lerp(state.end, 1 / (samples - 0.5))
        first = state.at.minimum(spread).maximum(state.t + state.tolerance)
        along = torch.lerp(state.t, first, order)
        at = along[1:]
        after = values(lines, at)
        before = torch.cat([state.value[None], after[:-1]])
        found, clear, drop = _advanced(state._replace(t=along[:-1], value=before, at=at), after, error)
        passed = (clear & (drop < after))[:-1].cumprod(0).sum(0)
        ray = torch.arange(len(passed), device=passed.device)
        placed = torch.stack(found[:PLACED])[:, passed, ray].unbind(0)
        found = State(*placed, *found[PLACED:])
        lowest, place = after.masked_fill(at > state.end, torch.inf).min(0)
        where = at[place, ray]
    closest = torch.where(lowest < state.least, where, state.closest)
    return found._replace(least=torch.fmin(lowest, state.least), closest=closest)


@lru_cache
def _order(samples: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "k 1"]:
    """From 0 to a number of samples; kept, as it serves every query."""
    return torch.arange(samples + 1, dtype=dtype, device=device)[:, None]


def _advanced(
    state: State, after: Float[Tensor, "*k n"], error: float | None
) -> tuple[State, Bool[Tensor, "*k n"], Float[Tensor, "*k n"]]:
    """The state after a query, which steps count, and by how much f fell.

    A step counts if the balls around its ends leave no more than the gap between them. The next one ends at the nearest
    of these: the root of the line through the last two values; where the balls around its ends, by the slope, leave
    half the gap; the end of the ray, or the middle of a step that did not count. The ray ends a bracket before a point
    inside; it goes on to one that is, by the slope, within the tolerance of the surface.
    """
    t, before, at, _, end, *_, gap, tolerance = state
    step, drop = at - t, before - after
    slope = torch.fmax(drop / step, FLAT)  # also where f is NaN, or the step zero
    uncovered = torch.sub(step - before, gap, alpha=2)  # what is left to the ball after
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
    moved, value = torch.where(clear, at, t), torch.where(clear, after, before)
    return state._replace(t=moved, value=value, at=following, root=root, end=end), clear, drop
