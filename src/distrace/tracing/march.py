"""Marching without gradients: cones of blocks, then single rays up to their first root."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.tracing.batch import Batch
from distrace.tracing.evaluator import Evaluator, Values

STUCK = 0.5  # of a cone's radius: a shorter step moves it no more
FLAT = 0.15  # slope along a ray, at most, from which a root is predicted: flatter rays graze the surface
AHEAD = 5e-4  # radii before a predicted root, at most, that may stay unchecked
GAP = 2e-3  # radii, at most, by which a step is longer than f, where the slope says that the ray stays outside …
GAP_MOST = 1e-2  # … twice as much with every step after which the slope is what it was, to BEND; up to this
BEND = 0.1
LEVEL = 0.05  # slope below which a ray counts as parallel to the surface


@dataclass(frozen=True)
class Roots:
    """Where rays are predicted to meet the surface first."""

    ray: Int[Tensor, "n"]  # its number in the batch
    t: Float[Tensor, "n"]
    slope: Float[Tensor, "n"]  # of f along the ray
    low: Float[Tensor, "n"]  # the last point outside
    high: Float[Tensor, "n"]  # the first inside; infinite while there is none


@dataclass(frozen=True)
class Marched:
    """What a march found; rays in neither list left the bounds."""

    roots: Roots
    stopped: Int[Tensor, "n"]  # rays that were still on their way, or in doubt …
    clear: Float[Tensor, "n"]  # … and how far they came
    inside: Int[Tensor, "begun"]  # rays that began inside
    closest: Float[Tensor, "rays"]  # where f was least, of all rays
    evaluations: Int[Tensor, "rays"]


def march_cones(evaluator: Evaluator, batch: Batch, reach: float, steps: int) -> Batch:
    """Moves each block's cone on while the ball around its middle ray that f keeps clear covers the cone.

    `reach` is the cone's radius in pixels. A ball of radius r at t covers the cone up to t + √(r² − ρ²), where ρ is the
    cone's radius at t + r at the farthest. Cones that leave the bounds are dropped.
    """
    t = batch.t.clone()
    active = torch.arange(len(t), device=t.device)
    some = batch
    for _ in range(steps):
        at = t[active]
        clear = evaluator.rough(some, at)
        radius = reach * some.pixel(at + clear)
        step = torch.where(clear > radius, (clear * clear - radius * radius).sqrt(), 0.0)
        t[active] = at + step
        go = ((step > STUCK * radius) & (at + step < some.far)).nonzero()[:, 0]
        active, some = active[go], some[go]
    return batch.from_(t)[(t < batch.far).nonzero()[:, 0]]


def march_rays(
    evaluate: Values, batch: Batch, steps: tuple[int, ...], *, error: float = 0.0, predict: bool = True
) -> Marched:
    """Sphere tracing of single rays until a root is predicted or bracketed.

    A step is as long as f, and by up to a gap longer where the slope along the ray says that it stays outside.
    `steps` tells how many steps are evaluated at once, each time; they count as far as f bears them out. Values are
    good to `error`: a ray that comes closer to the surface without a slope stops in doubt. Without `predict` only a
    change of sign is a root.
    """
    t = batch.t
    active = torch.arange(len(t), device=t.device)
    value = evaluate(batch, t)
    doubtful = ~(value > error)
    inside = (value <= -error).nonzero()[:, 0]
    least, closest = value.clone(), t.clone()
    evaluations = torch.ones_like(active)
    stopped, clear = [active[doubtful]], [t[doubtful]]
    rays, found = [], []
    state = torch.stack([t, value, torch.ones_like(t), torch.full_like(t, GAP)], dim=1)
    some, go = batch, (~doubtful).nonzero()[:, 0]
    for number, count in enumerate(steps):
        if not len(go):
            break
        some, active = some[go], active[go]
        t, value, last_slope, gap = state[go].unbind(1)
        longest = value / (0.9 * last_slope.abs().clamp_min(LEVEL))
        length = torch.minimum(value + gap, longest.maximum(value)).maximum(0.1 * gap)
        order = torch.arange(count + 1, device=t.device, dtype=t.dtype)[:, None]
        times = t + order * length
        ahead = evaluate(some, times[1:])
        values = torch.cat([value[None], ahead])
        allowed = length <= values[:-1] + 1.5 * gap
        last = ((ahead > error) & allowed).long().cumprod(0).sum(0).clamp_max(count - 1)[None]
        value, ahead, allowed = (rows.gather(0, last)[0] for rows in (values, ahead, allowed))
        t, following = (times.gather(0, at)[0] for at in (last, last + 1))
        slope = (ahead - value) / (following - t)
        root = following - ahead / slope
        crossed = allowed & (ahead <= -error)
        near = allowed & predict & (slope < -FLAT) & (root - following < ahead + AHEAD)
        unsure = allowed & ~(crossed | near) & ~(ahead.abs() > error)
        t_next = torch.where(allowed, following, t)
        going = ~(crossed | near | unsure) & (t_next < some.far)
        low = torch.where(allowed & (ahead > error), following, t)
        high = torch.where(crossed, following, torch.inf)
        ends = (crossed | near).nonzero()[:, 0]
        rays.append(active[ends])
        found.append(torch.stack([root, slope, low, high], dim=1)[ends])
        if number == len(steps) - 1:
            unsure = unsure | going
        stopped.append(active[unsure])
        clear.append(low[unsure])
        nearer = ahead.abs() < least[active]
        least[active] = torch.where(nearer, ahead.abs(), least[active])
        closest[active] = torch.where(nearer, following, closest[active])
        evaluations[active] += count
        gap = torch.where((slope - last_slope).abs() < BEND, (2 * gap).clamp_max(GAP_MOST), GAP)
        state = torch.stack([t_next, torch.where(allowed, ahead, value), slope, gap], dim=1)
        go = going.nonzero()[:, 0]
    parts = torch.cat(found).unbind(1) if found else [t[:0]] * 4
    roots = Roots(torch.cat(rays) if rays else active[:0], *parts)
    return Marched(roots, torch.cat(stopped), torch.cat(clear), inside, closest, evaluations)
