"""Sphere tracing without gradients: one march, whose configurations are DIST's strategies (Liu et al., CVPR 2020)."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.field import SDF, asked
from distrace.rays import Bounds, Rays


class Outcome(IntEnum):
    """What became of a ray."""

    ESCAPED = 0  # left the bounds, or never met them
    HIT = 1  # |sdf| fell below the tolerance
    EXHAUSTED = 2  # neither, within the steps; or the field gave NaN
    INSIDE = 3  # starts in the solid


@dataclass(frozen=True)
class TraceConfig:
    """How rays are marched: t ← t + step_scale · f, until |f| < tolerance."""

    steps: int = 100
    step_scale: float = 1.5  # above 1 is DIST's aggressive marching: the sign of f walks an overshoot back
    step_limit: float = 0.1  # f is clamped to ± this: decoders are trained on clamped distances and know no larger one
    tolerance: float | Float[Tensor, "*batch"] = 5e-5  # also per ray, as `Camera.tolerance` gives it
    compaction: bool = True  # only rays still on their way are queried; without, every ray at every step
    least_step: float = 0.0  # a ray that grazes the surface goes on by this at least, while it is outside
    polish: bool = True  # a ray that converged goes on to the zero of the secant through its last two samples
    coarse_levels: int = 2  # the march starts at 1 / 2^levels of the resolution …
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
        """The same march in a sphere of another radius than 1."""
        tolerance = self.tolerance if isinstance(self.tolerance, Tensor) else self.tolerance * radius
        limit, least = self.step_limit * radius, self.least_step * radius
        return replace(self, step_limit=limit, least_step=least, tolerance=tolerance)


PARALLEL = TraceConfig(steps=50, step_scale=1.0, compaction=False, coarse_levels=0)  # 50: as published
DYNAMIC = replace(PARALLEL, compaction=True)
AGGRESSIVE = replace(DYNAMIC, step_scale=1.5)
COARSE_TO_FINE = replace(AGGRESSIVE, coarse_levels=2)
MARCHES = {"parallel": PARALLEL, "dynamic": DYNAMIC, "aggressive": AGGRESSIVE, "coarse_to_fine": COARSE_TO_FINE}


@dataclass(frozen=True)
class Trace:
    """Where rays ended. Distances are along the unit ray; `inf` where a ray did not hit."""

    distance: Float[Tensor, "*batch"]
    outcome: Int[Tensor, "*batch"]
    closest: Float[Tensor, "*batch"]  # the distance at which |sdf| was least
    stopped: Float[Tensor, "*batch"]  # where the march stood when it ended, whatever the outcome
    evaluations: Int[Tensor, "*batch"]  # of the field, for this ray
    setup_evaluations: int = 0  # of the field, for no single ray: coarse levels, a lattice
    slope: Float[Tensor, "*batch"] | None = None  # of f along the ray at its hit, where the tracer knows it; else NaN

    @property
    def hit(self) -> Bool[Tensor, "*batch"]:
        return self.outcome == Outcome.HIT

    @property
    def total_evaluations(self) -> int:
        return self.setup_evaluations + int(self.evaluations.sum())

    def reshaped(self, shape: torch.Size) -> "Trace":
        return self.of(lambda part: part.reshape(shape))

    def __getitem__(self, index: Tensor | tuple) -> "Trace":
        return self.of(lambda part: part[index])

    def scaled(self, length: float, slope: float = 1.0) -> "Trace":
        """The same in a world whose lengths are × `length`, of a field whose slopes are × `slope`."""
        changed = {name: getattr(self, name) * length for name in ("distance", "closest", "stopped")}
        return replace(self, **changed, slope=None if self.slope is None else self.slope * slope)

    def of(self, change: Callable[[Tensor], Tensor]) -> "Trace":
        """The same with every image changed."""
        return replace(self, **{name: change(part) for name, part in self.images().items()})

    def images(self) -> dict[str, Tensor]:
        """All that is known of each ray."""
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

    A ray's result does not depend on the rays beside it. The last step of a ray goes to the zero of the secant through
    its last two values, which costs no query; a ray whose field gives NaN ends there, EXHAUSTED. Coarse levels belong
    to images: see `pyramid.starts`.
    """
    march = _March.begin(rays.detach().flat(), bounds, config, start)
    for _ in range(config.steps):
        if not march.step(sdf, config):
            break
    return march.result().reshaped(rays.shape)


@dataclass
class _March:
    """The state of all rays that meet the bounds, flat."""

    rays: Rays
    near: Tensor
    far: Tensor
    tolerance: Tensor
    t: Tensor
    last_t: Tensor  # the sample before, for the secant
    last_value: Tensor
    outside: Tensor  # the last sample with f > 0 before `inside`, for the bracket
    inside: Tensor  # the first with f < 0
    least: Tensor  # |sdf| at `closest`
    closest: Tensor
    outcome: Tensor  # -1: still on its way
    evaluations: Tensor

    @staticmethod
    def begin(rays: Rays, bounds: Bounds, config: TraceConfig, start: Tensor | None) -> "_March":
        near, far = bounds.near.reshape(-1), bounds.far.reshape(-1)
        meets = near < far
        t = near if start is None else start.reshape(-1).clamp(near, far)
        nothing = torch.full_like(near, torch.nan)
        tolerance = torch.as_tensor(config.tolerance, dtype=near.dtype, device=near.device)
        return _March(
            rays,
            near,
            far,
            tolerance.expand(bounds.near.shape).reshape(-1),
            torch.where(meets, t, torch.inf),
            last_t=nothing,
            last_value=nothing.clone(),
            outside=torch.full_like(near, -torch.inf),
            inside=torch.full_like(near, torch.inf),
            least=torch.full_like(near, torch.inf),
            closest=torch.where(meets, t, torch.inf),
            outcome=torch.where(meets, -1, int(Outcome.ESCAPED)),
            evaluations=torch.zeros_like(near, dtype=torch.int64),
        )

    def step(self, sdf: SDF, config: TraceConfig) -> bool:
        """One query of the rays on their way (or of all); False once there are none."""
        under_way = (self.outcome == -1).nonzero()[:, 0]
        if not len(under_way):
            return False
        queried = under_way if config.compaction else (self.near < self.far).nonzero()[:, 0]
        self.evaluations[queried] += 1
        value = asked(sdf, self.rays[queried].at(self.t[queried]))
        if not config.compaction:
            value = value[self.outcome[queried] == -1]
        self._record(under_way, value)
        self._advance(under_way, value, config)
        return True

    def _record(self, at: Tensor, value: Tensor) -> None:
        nearer = value.abs() < self.least[at]
        self.least[at] = torch.where(nearer, value.abs(), self.least[at])
        self.closest[at] = torch.where(nearer, self.t[at], self.closest[at])

    def _advance(self, at: Tensor, value: Tensor, config: TraceConfig) -> None:
        t, near, tolerance = self.t[at], self.near[at], self.tolerance[at]
        last_value = self.last_value[at]
        to_zero = -value * (t - self.last_t[at]) / (value - last_value)  # of the line through this sample and the last
        converged = value.abs() < tolerance
        inside = (t <= near) & (value < 0) & ~converged
        step = config.step_scale * value.clamp(-config.step_limit, config.step_limit)
        step = torch.where(value > 0, step.clamp_min(config.least_step), step)
        # Where step_scale · |f'| along the ray is near 2 or above, the march would bounce about the zero.
        bounces = (value * last_value < 0) & (value.abs() > 0.7 * last_value.abs())
        following = self._bracketed(at, t, value, torch.where(bounces, t + to_zero, (t + step).maximum(near)))
        escaped = (following > self.far[at]) & ~converged
        outcome = torch.full_like(self.outcome[at], -1)
        ends = ((escaped, Outcome.ESCAPED), (inside, Outcome.INSIDE), (converged, Outcome.HIT))
        for reached, name in (*ends, (value.isnan(), Outcome.EXHAUSTED)):
            outcome = outcome.masked_fill(reached, int(name))
        self.outcome[at] = outcome
        end = (t + _polish(value, to_zero)).clamp(near, self.far[at]) if config.polish else t
        self.t[at] = torch.where(converged, end, torch.where(outcome == -1, following, t))
        self.last_t[at], self.last_value[at] = t, value

    def _bracketed(self, at: Tensor, t: Tensor, value: Tensor, proposed: Tensor) -> Tensor:
        """The proposed distance, but the middle of a sign change that would be jumped out of."""
        inside = torch.where(value < 0, t.minimum(self.inside[at]), self.inside[at])
        outside = torch.where((value > 0) & (t < inside), t, self.outside[at])
        self.inside[at], self.outside[at] = inside, outside
        jumps = (inside < torch.inf) & (outside > -torch.inf) & ((proposed <= outside) | (proposed >= inside))
        return torch.where(jumps, (outside + inside) / 2, proposed)

    def result(self) -> Trace:
        outcome = self.outcome.masked_fill(self.outcome == -1, int(Outcome.EXHAUSTED))
        hit = outcome == Outcome.HIT
        closest = torch.where(hit, self.t, self.closest)
        return Trace(self.t.masked_fill(~hit, torch.inf), outcome, closest, self.t, self.evaluations)


def _polish(value: Tensor, to_zero: Tensor) -> Tensor:
    """From a converged sample to the zero of the secant; else by the value itself.

    The latter on a first sample (where the secant is NaN, which compares false) and along the surface: a step by the
    distance never leads too far.
    """
    return torch.where(to_zero.abs() <= 20 * value.abs(), to_zero, value)
