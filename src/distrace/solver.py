"""Levenberg–Marquardt on exact Jacobians: for problems of few unknowns, ten times fewer iterations than Adam.

Marquardt, SIAM J. 1963; damping as in Madsen, Nielsen and Tingleff, *Methods for Non-Linear Least Squares*, 2004.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

State = TypeVar("State")
LEAST_DAMPING, LARGEST_DAMPING = 1e-7, 1e7
LEAST_CURVATURE = 1e-9  # of an unknown that nothing depends on, so that it stays where it is


@dataclass(frozen=True)
class SolverConfig:
    """Residuals beyond `scale` count less and less (Cauchy); it starts wider, so that a far start is not an outlier."""

    iterations: int = 30
    damping: float = 1e-2  # at first, relative to each unknown's curvature
    scale: float = 1.0
    widest: float = 1.0  # × scale, at first …
    narrowing: float = 0.7  # … and from one iteration to the next
    settled: float = 1e-4  # a step that lowers the loss by less, relatively, is the last, and so is one as short

    def __post_init__(self) -> None:
        if self.iterations < 1 or not self.scale > 0 or not self.widest >= 1:
            raise ValueError(f"{self} solves nothing; it takes an iteration, a positive scale and a widest of 1 or more")

    def scale_at(self, iteration: int) -> float:
        return self.scale * max(1.0, self.widest * self.narrowing**iteration)


@dataclass(frozen=True)
class Residuals:
    """What is to vanish, its derivatives by the unknowns, and how much each counts."""

    values: Float[Tensor, "n"]
    jacobian: Float[Tensor, "n unknowns"]
    weights: Float[Tensor, "n"]

    def loss(self, scale: float) -> float:
        """Σ w · c² log(1 + r²/c²) / 2, for residuals far below c that is Σ w r² / 2."""
        return float((self.weights * scale**2 * (self.values / scale).square().log1p()).sum() / 2)

    def step(self, scale: float, damping: float) -> Float[Tensor, "unknowns"]:
        """The minimum of the damped quadratic, outliers down-weighted."""
        weights = (self.weights / (1 + (self.values / scale).square()))[:, None]
        jacobian, values = self.jacobian.double(), self.values.double()
        curvature = jacobian.T @ (weights * jacobian)
        damped = curvature.diagonal() * damping + LEAST_CURVATURE
        return -torch.linalg.solve(curvature + damped.diag(), jacobian.T @ (weights[:, 0] * values)).to(self.values)


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
    state, damping, growth = start, config.damping, 2.0
    now = residuals(state)
    for iteration in range(config.iterations):
        began, scale = time.perf_counter(), config.scale_at(iteration)
        step = now.step(scale, damping)
        candidate = moved(state, step)
        then = residuals(candidate)
        before, after = now.loss(scale), then.loss(scale)
        accepted = after < before
        if accepted:
            state, now, damping, growth = candidate, then, max(damping / 4, LEAST_DAMPING), 2.0
        else:
            damping, growth = min(damping * growth, LARGEST_DAMPING), 2 * growth
        seconds = time.perf_counter() - began
        yield Solution(iteration + 1, state, now.loss(config.scale), damping, accepted, seconds, now)
        little = step.norm() <= config.settled or abs(before - after) <= config.settled * before
        if little and scale == config.scale_at(config.iterations):
            return
