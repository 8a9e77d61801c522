"""Sphere tracing without gradients: one march, whose configurations are DIST's strategies (Liu et al., CVPR 2020)."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.equality import ByValue, summary
from distrace.fields.base import SDF, at_rows, check_field, evaluate_checked
from distrace.rays import Bounds, Rays


class Outcome(IntEnum):
    """The outcome of a ray."""

    ESCAPED = 0  # left the bounds, or never met them
    HIT = 1  # the surface is within the tolerance
    EXHAUSTED = 2  # neither, within the steps; or the field gave NaN
    INSIDE = 3  # starts in the solid


@dataclass(frozen=True, eq=False, repr=False)
class TraceConfig(ByValue):
    """A sphere tracing strategy: t ← t + step_scale · f, until |f| < tolerance. Lengths are in radii."""

    steps: int = 400
    step_scale: float = 1.0  # above 1 is DIST's aggressive marching: the sign of f walks an overshoot back
    step_limit: float = 0.1  # f is clamped to ± this: decoders are trained on clamped distances
    tolerance: float | Float[Tensor, "*batch"] = 5e-5  # also per ray, as `Camera.tolerance` gives it
    compaction: bool = True  # only active rays are evaluated; without, every ray at every step
    least_step: float = 0.0  # the least step of a ray outside, for rays that graze the surface
    polish: bool = True  # a ray that converged goes on to the zero of the secant through its last two samples
    coarse_levels: int = 0  # the march starts at 1 / 2^levels of the resolution …
    coarse_steps: int = 3  # … and splits each ray into four after so many steps

    def __post_init__(self) -> None:
        lengths = [self.step_scale, self.step_limit]
        if isinstance(self.tolerance, float):
            lengths.append(self.tolerance)
        if self.steps < 1 or not all(length > 0 for length in lengths) or self.coarse_levels < 0:
            raise ValueError(
                f"{self} cannot march: steps, step_scale, step_limit and tolerance must be positive, and levels ≥ 0"
            )

    def within(self, radius: float) -> "TraceConfig":
        """Returns the same strategy for a sphere of another radius than 1."""
        tolerance = self.tolerance if isinstance(self.tolerance, Tensor) else self.tolerance * radius
        step_limit = self.step_limit * radius
        return replace(self, step_limit=step_limit, least_step=self.least_step * radius, tolerance=tolerance)


PARALLEL = TraceConfig(steps=50, step_scale=1.0, compaction=False, coarse_levels=0)  # 50: as published
DYNAMIC = replace(PARALLEL, compaction=True)
AGGRESSIVE = replace(DYNAMIC, step_scale=1.5)
COARSE_TO_FINE = replace(AGGRESSIVE, coarse_levels=2)
MARCHES = {"parallel": PARALLEL, "dynamic": DYNAMIC, "aggressive": AGGRESSIVE, "coarse_to_fine": COARSE_TO_FINE}


@dataclass(frozen=True, eq=False, repr=False)
class Trace(ByValue):
    """The result of a trace, for each ray. Distances are along the unit ray; `inf` where a ray did not hit."""

    distance: Float[Tensor, "*batch"]
    outcome: Int[Tensor, "*batch"]
    closest: Float[Tensor, "*batch"]  # the distance at which |sdf| was least
    stopped: Float[Tensor, "*batch"]  # the distance at which the march ended, whatever the outcome
    evaluations: Int[Tensor, "*batch"]  # of the field, for this ray
    setup_evaluations: int = 0  # of the field, for all rays together: coarse levels; cells and blocks of pixels

    @property
    def hit(self) -> Bool[Tensor, "*batch"]:
        return self.outcome == Outcome.HIT

    @property
    def total_evaluations(self) -> int:
        return self.setup_evaluations + int(self.evaluations.sum())

    def __repr__(self) -> str:
        return f"Trace({summary(self.distance)}, {int(self.hit.sum()):,} hits, {self.total_evaluations:,} evaluations)"

    def reshaped(self, shape: torch.Size) -> "Trace":
        return self.of(lambda part: part.reshape(shape))

    def __getitem__(self, index: Tensor | tuple[Any, ...]) -> "Trace":
        return self.of(lambda part: part[index])

    def of(self, change: Callable[[Tensor], Tensor]) -> "Trace":
        """Returns the trace with every image changed."""
        return replace(self, **{name: change(part) for name, part in self.images().items()})

    def images(self) -> dict[str, Tensor]:
        """Returns the images by their names."""
        parts = {part.name: getattr(self, part.name) for part in fields(self)}
        return {name: part for name, part in parts.items() if isinstance(part, Tensor)}


@torch.no_grad()
def sphere_trace(
    sdf: SDF,
    rays: Rays,
    bounds: Bounds,
    config: TraceConfig = TraceConfig(),
    start: Float[Tensor, "*batch"] | None = None,
) -> Trace:
    """Marches every ray within its bounds, from `near` or from `start`.

    A ray's result does not depend on other rays. The last step of a ray goes to the zero of the secant through its last
    two values, which costs no evaluation. A ray ends EXHAUSTED where its field is NaN. Coarse levels belong to images:
    see `coarse_to_fine.starts`. Raises `TypeError` for a model instead of its field.

    >>> from distrace.rays import meet_sphere
    >>> rays = Rays(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]]))
    >>> sphere_trace(lambda points: points.norm(dim=-1) - 0.5, rays, meet_sphere(rays)).distance
    tensor([1.5000])
    """
    check_field(sdf)
    march = _March.begin(rays.detach().flat(), bounds, config, start)
    for _ in range(config.steps):
        if not march.step(sdf, config):
            break
    return march.result().reshaped(rays.shape)


class _State(NamedTuple):
    """Per-ray march state, which `_March` stores as one [7, n] tensor to save gathers."""

    t: Float[Tensor, "n"]
    last_t: Float[Tensor, "n"]  # the previous sample, for the secant
    last_value: Float[Tensor, "n"]
    outside: Float[Tensor, "n"]  # the last sample with f > 0 before `inside`, for the bracket
    inside: Float[Tensor, "n"]  # the first with f < 0
    least: Float[Tensor, "n"]  # |sdf| at `closest`
    closest: Float[Tensor, "n"]

    def sampled(self, value: Float[Tensor, "n"], magnitude: Float[Tensor, "n"]) -> "_State":
        """Returns the state with the value at t: it updates the bracket and the nearest sample."""
        t = self.t
        nearer = magnitude < self.least
        inside = torch.where(value < 0, t.minimum(self.inside), self.inside)
        outside = torch.where((value > 0) & (t < inside), t, self.outside)
        least = torch.where(nearer, magnitude, self.least)
        closest = torch.where(nearer, t, self.closest)
        return _State(t, t, value, outside, inside, least, closest)

    def bracketed(self, proposed: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Returns the proposed distance, or the middle of a bracket that it would leave."""
        jumps = (self.inside < torch.inf) & (self.outside > -torch.inf)
        jumps &= (proposed <= self.outside) | (proposed >= self.inside)
        return torch.where(jumps, (self.outside + self.inside) / 2, proposed)


@dataclass
class _March:
    """All rays that meet the bounds, flat."""

    rays: Rays
    limits: Float[Tensor, "3 n"]  # near, far, tolerance
    state: Float[Tensor, "7 n"]
    outcome: Int[Tensor, "n"]  # -1: active
    evaluations: Int[Tensor, "n"]

    @staticmethod
    def begin(rays: Rays, bounds: Bounds, config: TraceConfig, start: Tensor | None) -> "_March":
        near = bounds.near.reshape(-1)
        far = bounds.far.reshape(-1)
        meets = near < far
        t = torch.where(meets, near if start is None else start.reshape(-1).clamp(near, far), torch.inf)
        tolerance = torch.as_tensor(config.tolerance, dtype=near.dtype, device=near.device)
        unknown = torch.full_like(near, torch.nan)
        infinite = torch.full_like(near, torch.inf)
        return _March(
            rays,
            limits=torch.stack([near, far, tolerance.expand(bounds.near.shape).reshape(-1)]),
            state=torch.stack(_State(t, unknown, unknown, -infinite, infinite, infinite, t)),
            outcome=torch.where(meets, -1, int(Outcome.ESCAPED)),
            evaluations=torch.zeros_like(near, dtype=torch.int64),
        )

    @property
    def rows(self) -> _State:
        """The state by its names."""
        return _State(*self.state)

    def step(self, sdf: SDF, config: TraceConfig) -> bool:
        """Evaluates the active rays (or all of them) once; returns False if none is active."""
        active = (self.outcome == -1).nonzero()[:, 0]
        if not len(active):
            return False
        queried = active if config.compaction else (self.limits[0] < self.limits[1]).nonzero()[:, 0]
        self.evaluations[queried] += 1
        value = evaluate_checked(at_rows(sdf, queried), self.rays[queried].at(self.rows.t[queried]))
        if not config.compaction:
            value = value[self.outcome[queried] == -1]
        outcome, state = _advanced(_State(*self.state[:, active]), value, self.limits[:, active], config)
        self.outcome[active] = outcome
        self.state[:, active] = torch.stack(state)
        return True

    def result(self) -> Trace:
        outcome = self.outcome.masked_fill(self.outcome == -1, int(Outcome.EXHAUSTED))
        t = self.rows.t
        hit = outcome == Outcome.HIT
        closest = torch.where(hit, t, self.rows.closest)
        return Trace(t.masked_fill(~hit, torch.inf), outcome, closest, t, self.evaluations)


def _advanced(
    state: _State, value: Float[Tensor, "n"], limits: Float[Tensor, "3 n"], config: TraceConfig
) -> tuple[Int[Tensor, "n"], _State]:
    """Returns outcome and state of rays after a step, from the field's `value` at t."""
    near, far, tolerance = limits
    magnitude = value.abs()
    t = state.t
    to_zero = -value * (t - state.last_t) / (value - state.last_value)  # of the secant through the last two samples
    proposed = _proposed(state, value, to_zero, config).maximum(near)
    state = state.sampled(value, magnitude)
    following = state.bracketed(proposed)
    converged = magnitude < tolerance
    outcome = torch.full_like(value, -1, dtype=torch.int64)
    outcome.masked_fill_((following > far) & ~converged, int(Outcome.ESCAPED))
    outcome.masked_fill_((t <= near) & (value < 0) & ~converged, int(Outcome.INSIDE))
    outcome.masked_fill_(converged, int(Outcome.HIT))
    outcome.masked_fill_(value.isnan(), int(Outcome.EXHAUSTED))
    end = (t + _polish(value, to_zero)).clamp(near, far) if config.polish else t
    return outcome, state._replace(t=torch.where(converged, end, torch.where(outcome == -1, following, t)))


def _proposed(state: _State, value: Tensor, to_zero: Tensor, config: TraceConfig) -> Float[Tensor, "n"]:
    """Returns the distance after a step by the value, or by the secant where that would oscillate about the zero.

    It would oscillate where step_scale · |f'| along the ray is near 2 or above.
    """
    step = config.step_scale * value.clamp(-config.step_limit, config.step_limit)
    step = torch.where(value > 0, step.clamp_min(config.least_step), step)
    oscillates = (value * state.last_value < 0) & (value.abs() > 0.7 * state.last_value.abs())
    return state.t + torch.where(oscillates, to_zero, step)


def _polish(value: Tensor, to_zero: Tensor) -> Tensor:
    """Returns the step from a converged sample to the zero of the secant, or else by the value itself.

    The latter on a first sample (where the secant is NaN, which compares false) and along the surface, as a step by the
    distance never leads too far.
    """
    return torch.where(to_zero.abs() <= 20 * value.abs(), to_zero, value)
