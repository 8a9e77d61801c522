"""Levenberg–Marquardt on exact Jacobians: for problems of few unknowns, ten times fewer iterations than Adam.

Marquardt, SIAM J. 1963; damping as in Madsen, Nielsen and Tingleff, *Methods for Non-Linear Least Squares*, 2004.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

State = TypeVar("State")
Kernel = Callable[[Float[Tensor, "n"]], tuple[Float[Tensor, "n"], Float[Tensor, "n"]]]
"""From squared residuals, in units of the scale, to their losses and to how much less they weigh than if squared."""

LEAST_DAMPING, LARGEST_DAMPING = 1e-7, 1e7
LEAST_CURVATURE = 1e-9  # of an unknown that nothing depends on, so that it stays where it is


def cauchy(squared: Float[Tensor, "n"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Outliers hardly count."""
    return squared.log1p(), 1 / (1 + squared)


def charbonnier(squared: Float[Tensor, "n"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Far residuals count by their absolute values: as robust as a convex loss can be."""
    root = (1 + squared).sqrt()
    return 2 * squared / (1 + root), 1 / root  # 2 (√(1 + x) − 1), but exact where 1 + x rounds to 1


@dataclass(frozen=True)
class SolverConfig:
    """Residuals beyond `scale` count less, as the kernel has it; it starts wider, so that a far start is no outlier."""

    iterations: int = 30
    damping: float = 1e-2  # at first, relative to each unknown's curvature …
    even: bool = False  # … or to the mean one: where unknowns are alike, so that what nothing was seen of stays
    scale: float = 1.0
    widest: float = 1.0  # × scale, at first …
    narrowing: float = 0.7  # … and from one iteration to the next
    kernel: Kernel = cauchy
    settled: float = 1e-4  # a step that lowers the loss by less, relatively, is the last, and so is one as short

    def __post_init__(self) -> None:
        if self.iterations < 1 or not self.scale > 0 or not self.widest >= 1:
            raise ValueError(f"{self} solves nothing; it takes iterations, a positive scale and a widest of at least 1")

    def scale_at(self, iteration: int) -> float:
        return self.scale * max(1.0, self.widest * self.narrowing**iteration)


@dataclass(frozen=True)
class Residuals:
    """What is to vanish, its derivatives by the unknowns, and how much each counts."""

    values: Float[Tensor, "n"]
    jacobian: Float[Tensor, "n unknowns"]
    weights: Float[Tensor, "n"]

    def loss(self, scale: float, kernel: Kernel = cauchy) -> float:
        """Σ w · c² ρ(r²/c²) / 2, for residuals far below c that is Σ w r² / 2."""
        losses, _ = kernel((self.values / scale).square())
        return float((self.weights * scale**2 * losses).sum() / 2)

    def step(
        self, scale: float, damping: float, kernel: Kernel, even: bool = False
    ) -> tuple[Float[Tensor, "unknowns"], float]:
        """The minimum of the damped quadratic, outliers down-weighted; and by how much it should lower the loss.

        Each unknown is damped in proportion to its own curvature or, if `even`, to the mean one.
        """
        _, shares = kernel((self.values / scale).square())
        weights = (self.weights * shares)[:, None]
        jacobian, values = self.jacobian.double(), self.values.double()
        curvature, slope = jacobian.T @ (weights * jacobian), jacobian.T @ (weights[:, 0] * values)
        own = curvature.diagonal()
        damped = (own.mean().expand(own.shape) if even else own) * damping + LEAST_CURVATURE
        step = -torch.linalg.solve(curvature + damped.diag(), slope)
        return step.to(self.values), float(step @ (damped * step - slope)) / 2


@dataclass
class Descent(Generic[State]):
    """The way down from one start: the best state so far, and how the next step is damped."""

    state: State
    residuals: Residuals
    damping: float
    growth: float = 2.0  # of the damping, at the next step that is rejected
    accepted: bool = False
    settled: bool = False  # no further step lowers the loss


def descend(
    descents: Sequence[Descent[State]],
    residuals: Callable[[Sequence[State]], Sequence[Residuals]],
    moved: Callable[[Sequence[State], Sequence[Float[Tensor, "unknowns"]]], Sequence[State]],
    config: SolverConfig,
    iteration: int,
) -> None:
    """One iteration of several starts, each with its own damping, whose states are moved and evaluated together."""
    scale, kernel = config.scale_at(iteration), config.kernel
    steps = [each.residuals.step(scale, each.damping, kernel, config.even) for each in descents]
    candidates = moved([descent.state for descent in descents], [step for step, _ in steps])
    tried = zip(descents, steps, candidates, residuals(candidates), strict=True)
    for descent, (step, expected), candidate, then in tried:
        before, after = descent.residuals.loss(scale, kernel), then.loss(scale, kernel)
        descent.accepted = after < before
        if descent.accepted:
            gain = (before - after) / max(expected, 1e-30)
            descent.damping = max(descent.damping * max(1 / 4, 1 - (2 * gain - 1) ** 3), LEAST_DAMPING)
            descent.growth, descent.state, descent.residuals = 2.0, candidate, then
        else:
            descent.damping = min(descent.damping * descent.growth, LARGEST_DAMPING)
            descent.growth *= 2
        little = step.norm() <= config.settled or abs(before - after) <= config.settled * before
        descent.settled = bool(little) and scale == config.scale_at(config.iterations)


@dataclass(frozen=True)
class Solution(Generic[State]):
    """Where an iteration stands: the best state so far, and its loss at the scale of the end."""

    iteration: int
    state: State
    loss: float
    damping: float
    accepted: bool
    seconds: float
    residuals: Residuals


def minimise(
    residuals: Callable[[State], Residuals],
    start: State,
    moved: Callable[[State, Float[Tensor, "unknowns"]], State],
    config: SolverConfig = SolverConfig(),
) -> Iterator[Solution[State]]:
    """Moves a state along the unknowns' steps until its residuals vanish, or no step lowers the loss."""
    descent = Descent(start, residuals(start), config.damping)
    for iteration in range(config.iterations):
        began = time.perf_counter()
        descend([descent], lambda states: [residuals(states[0])], lambda x, by: [moved(x[0], by[0])], config, iteration)
        seconds, now = time.perf_counter() - began, descent.residuals
        loss = now.loss(config.scale, config.kernel)
        yield Solution(iteration + 1, descent.state, loss, descent.damping, descent.accepted, seconds, now)
        if descent.settled:
            return
