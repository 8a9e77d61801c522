"""Marching without gradients: cones of blocks of pixels, then single rays in lock step up to their first root."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.tracing.images import Lines

Values = Callable[[Lines, Float[Tensor, "*k n"]], Float[Tensor, "*k n"]]
NEVER = 1e3  # radii: farther than any place on a ray
# In how many places at once a ray is looked at, look by look; what becomes of it does not hang on other rays.
ROUGH = (1, 1, 1, 2, 3)  # by rough values, as often as cones are looked at …
NEAR = (1, 1, 4, 8, 16, 32, *[64] * 42)  # … and by exact ones after these: rays that graze the surface take many
ALONE = (*[1] * 4, 2, 2, 4, 4, 8, 8, 16, 16, *[32] * 36)  # by exact ones where there are no rough ones
Looked = tuple[Int[Tensor, "_"], int]
"""Rays that were looked at together, and in how many places each."""


class State(NamedTuple):
    """What is known of rays, in radii. Each is clear up to `t`, but for gaps. The last three stay as they are."""

    t: Float[Tensor, "n"]
    value: Float[Tensor, "n"]  # of f at t; NEVER if that is not known
    at: Float[Tensor, "n"]  # where f is looked at next
    end: Float[Tensor, "n"]  # where the ray is done: beyond is no surface or, after a bracket, a point inside
    root: Float[Tensor, "n"]  # of the line through the last two values
    least: Float[Tensor, "n"]  # f so far …
    closest: Float[Tensor, "n"]  # … and where that was
    going: Float[Tensor, "n"]  # 1 until nothing more is to be looked at
    gap: Float[Tensor, "n"]  # half of what the balls around two samples may leave between them
    tolerance: Float[Tensor, "n"]  # how far off a hit may be …
    bracket: Float[Tensor, "n"]  # … and in how short a bracket the root of the line is taken

    @staticmethod
    def of_spans(t: Float[Tensor, "n"], end: Float[Tensor, "n"], *limits: Float[Tensor, "n"]) -> "State":
        """Of rays that are clear before t and after an end, with what stays as it is."""
        never = torch.full_like(t, NEVER)
        return State(t, never, t, end, never, never, t, torch.ones_like(t), *limits)


CHANGING = State._fields.index("gap")  # of the facts, so many


def march_cones(
    values: Values,
    lines: Lines,
    span: Float[Tensor, "3 n"],
    radius: Float[Tensor, "n"],
    looks: int,
    error: float,
) -> Float[Tensor, "3 n"]:
    """Moves each block's cone on while the ball around its middle ray that f keeps clear covers the cone.

    `span` tells from where and up to where a cone may see surface, where it began; `radius` is the cone's at the end. A
    ball of radius r covers a cone of radius ρ for √(r² − ρ²) from its middle. Values are good to an `error`, which is
    taken off.
    """
    t, far, begin = span.unbind(0)
    zero = span.new_zeros(())
    for _ in range(looks):
        clear = torch.fmax(values(lines, t) - error, zero)  # also where f is NaN
        t = t + torch.addcmul(clear * clear, radius, radius, value=-1).clamp_min(0).sqrt()
    return torch.stack([t, far, begin])


def march(
    values: Values,
    lines: Lines,
    states: Float[Tensor, "11 n"],
    active: Int[Tensor, "m"],
    places: tuple[int, ...],
    error: float | None = None,
) -> list[Looked]:
    """Looks at the active rays in lock step, and writes what became of them to `states`.

    `places` tells in how many of them each ray is looked at, look by look. Values that are good to an `error` never
    decide on a hit: rays where f is no greater are left alone.
    """
    changing = states[:CHANGING]
    looked = []
    for count in places:
        if not len(active):
            break
        some, state = lines[active], State(*states.index_select(1, active).unbind(0))
        if count == 1:
            found, _, going = _advanced(state, values(some, state.at), error)
        else:
            found = _first(state, values, some, count, error)
            going = found[-1] > 0
        changing.index_copy_(1, active, found)
        looked.append((active, count))
        active = active[going]
    return looked


def evaluations(looked: list[Looked], count: int) -> Int[Tensor, "n"]:
    """How often f was evaluated for each of so many rays."""
    rays = torch.cat([ray for ray, _ in looked])
    lengths, places = torch.tensor([(len(ray), places) for ray, places in looked], device=rays.device).unbind(1)
    return rays.bincount(places.repeat_interleave(lengths), count).long()


def _first(state: State, values: Values, lines: Lines, places: int, error: float | None) -> Float[Tensor, "8 n"]:
    """Looks ahead in several places, as far apart as one would be, and tells what is known after the first to stop at.

    They fill the rest of the ray evenly where that is short. A ray may pass a place if the line has no root before the
    next one.
    """
    order = torch.arange(places + 1, dtype=state.t.dtype, device=state.t.device)[:, None]
    first_place = state.at.minimum(state.t.lerp(state.end, 1 / (places - 0.5)))
    along = torch.lerp(state.t, first_place.maximum(state.t + state.tolerance), order).minimum(state.end)
    at = along[1:]
    after = values(lines, at)
    before = torch.cat([state.value[None], after[:-1]])
    found, clear, going = _advanced(state._replace(t=along[:-1], value=before, at=at), after, error)
    passes = clear & going & (2 * after > before)
    first = passes[:-1].cumprod(0).sum(0)
    return found.gather(1, first.expand(CHANGING, 1, -1))[:, 0]


def _advanced(
    state: State, after: Float[Tensor, "*k n"], error: float | None
) -> tuple[Float[Tensor, "8 *k n"], Bool[Tensor, "*k n"], Bool[Tensor, "*k n"]]:
    """What is known after f was looked at, of all that changes; which steps count, and which rays go on.

    A step counts if the balls around its ends leave no more than the gap between them. The next one ends at the nearest
    of these: the root of the line through the last two values; where the balls around its ends, by the slope, leave
    half the gap; the end of the ray, or the middle of a step that did not count. A point where f is too small for the
    line's root to be far counts as the surface: the ray ends there, a bracket earlier.
    """
    t, before, at, end, _, least, closest, _, gap, tolerance, bracket = state
    step = (at - t).clamp_min(1e-12)  # an exact look may lie before a rough one
    covered = torch.add(before + after, gap, alpha=2) >= step
    slope = ((before - after) / step).clamp(1e-6, 1)  # downwards
    root = torch.addcdiv(at, after, slope)
    if error is None:
        small = tolerance * slope * slope
        outside = after > -small
        end = torch.where(after < small, torch.maximum(at, root) - bracket, end)
        end = end.amin(0).expand_as(at) if after.dim() > 1 else end
    else:
        outside = after > error
        end = end.expand_as(at)
    clear = covered & outside
    moved, value = torch.where(clear, at, t), torch.where(clear, after, before)
    going = moved < end if error is None else (moved < end) & outside
    balls = torch.addcdiv(at, torch.add(gap, after, alpha=2), slope + 1)
    limit = torch.where(covered, end, t.lerp(at, 0.5))
    following = torch.fmin(torch.fmin(root, balls), limit)  # also where f is NaN
    closest, least = torch.where(after < least, at, closest), torch.fmin(after, least)
    return torch.stack([moved, value, following, end, root, least, closest, going]), clear, going
