"""The slow oracle: sphere tracing of one ray after another, in plain Python numbers, written from the paper."""

import math
from collections.abc import Callable
from dataclasses import dataclass

Vector = tuple[float, float, float]
Field = Callable[[Vector], float]


@dataclass(frozen=True)
class Ended:
    outcome: str
    distance: float
    evaluations: int


def meet_sphere(origin: Vector, direction: Vector, radius: float = 1.0) -> tuple[float, float] | None:
    """The roots t of |o + t v|² = r², the first not before the origin; nothing where the ray misses."""
    half_b = sum(o * v for o, v in zip(origin, direction))
    discriminant = half_b**2 - (sum(o * o for o in origin) - radius**2)
    if discriminant <= 0 or -half_b + math.sqrt(discriminant) <= 0:
        return None
    return max(-half_b - math.sqrt(discriminant), 0.0), -half_b + math.sqrt(discriminant)


def march(
    sdf: Field,
    origin: Vector,
    direction: Vector,
    *,
    steps: int,
    step_scale: float,
    step_limit: float,
    tolerance: float,
    start: float | None = None,
) -> Ended:
    """What becomes of one ray within the unit sphere."""
    stretch = meet_sphere(origin, direction)
    if stretch is None:
        return Ended("ESCAPED", math.inf, 0)
    near, far = stretch
    t = near if start is None else min(max(start, near), far)
    before, outside, inside = None, -math.inf, math.inf
    for evaluations in range(1, steps + 1):
        value = sdf(tuple(o + t * v for o, v in zip(origin, direction)))
        if abs(value) < tolerance:
            return Ended("HIT", min(max(polished(t, value, before), near), far), evaluations)
        if value < 0 and t <= near:
            return Ended("INSIDE", math.inf, evaluations)
        proposed = t + step_scale * max(-step_limit, min(value, step_limit))
        if before is not None and value * before[1] < 0 and abs(value) > 0.7 * abs(before[1]):
            proposed = t - value * (t - before[0]) / (value - before[1])
        before = t, value
        inside = min(inside, t) if value < 0 else inside
        outside = t if value > 0 and t < inside else outside
        t = max(proposed, near)
        if math.isfinite(outside) and math.isfinite(inside) and not outside < t < inside:
            t = (outside + inside) / 2
        if t > far:
            return Ended("ESCAPED", math.inf, evaluations)
    return Ended("EXHAUSTED", math.inf, steps)


def polished(t: float, value: float, before: tuple[float, float] | None) -> float:
    """The zero of the secant through the last two samples, unless there is but one or it runs along the surface."""
    if before is not None and before[1] != value:
        move = -value * (t - before[0]) / (value - before[1])
        if abs(move) <= 20 * abs(value):
            return t + move
    return t + value


def sphere(centre: Vector, radius: float) -> Field:
    return lambda p: math.dist(p, centre) - radius


def box(half_extents: Vector) -> Field:
    def field(p: Vector) -> float:
        beyond = [abs(x) - h for x, h in zip(p, half_extents)]
        return math.hypot(*(max(b, 0.0) for b in beyond)) + min(max(beyond), 0.0)

    return field


def steeper(field: Field, factor: float) -> Field:
    return lambda p: factor * field(p)


def union(*fields: Field) -> Field:
    return lambda p: min(field(p) for field in fields)
