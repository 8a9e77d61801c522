"""A fit of a code from one start, in stages: what is far off pulls at first, and hardly in the end."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fitting.code_residuals import Comparison, Problem
from distrace.fitting.point_residuals import PointProblem
from distrace.fitting.solver import Kernel, Solution, SolverConfig, cauchy, charbonnier, minimise
from distrace.fitting.starts import Starts, Step, stages_of
from distrace.losses import Weights
from distrace.prior import Prior

ProblemOf = Callable[[torch.Generator, float], Problem | PointProblem]


@dataclass(frozen=True)
class CodeFitConfig(Starts):
    """Steps in stages, in which deviations beyond a scale count less.

    In the first stages, whose scale narrows, by their absolute values; in the last ones hardly.
    """

    iterations: int = 16
    kept: int = 3  # all of three starts: what a few iterations reach says little about the end
    more: int = 5
    hops: int = 5  # where depths are few
    doubtful: float = 0.025  # depths off by that, in radii of the unit sphere, or a quarter of the silhouette
    hop: float = 0.3  # by how many of the prior's deviations these leave the best end
    stages: int = 4
    depth_rays: int = 1000  # of each view
    mask_rays: int = 900  # few would be fitted for themselves: a code has 256 coordinates
    first_share: float = 0.3  # of them, in the first stage: while all is coarse
    sharpened: int = 3  # ends, where depths are few, otherwise the best one: from each of them …
    sharpening: int = 6  # … so many steps more, in which …
    outline_rays: int = 600  # … so many rays are to touch the surface
    compared: Comparison = Comparison(Weights(mask=30.0, code=0.05))  # both more than Adam's: docs/from_the_paper.md
    scale: float = 0.02  # at first: what is far off is no outlier …
    narrowing: float = 0.42  # … and × this from one stage to the next
    outlying: float = 0.01  # the scale of the last stages …
    robust: int = 2  # … and how many these are
    damping: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.stages, self.sharpened) < 1 or self.sharpening < 0:
            given = f"{self.stages} stages and {self.sharpening} steps of sharpening from {self.sharpened} ends"
            raise ValueError(f"{given} were asked for; there must be at least 1 stage and 1 end")

    @property
    def total(self) -> int:
        """Steps at most: where no silhouette is known it is not sharpened."""
        return super().total + (self.sharpening * min(self.sharpened, self.most) + 1 if self.sharpening else 0)

    def scale_and_kernel(self, stage: int) -> tuple[float, Kernel]:
        """A stage's scale, and how what is beyond it counts."""
        if stage >= self.stages - self.robust:
            return self.outlying, cauchy
        return self.scale * self.narrowing**stage, charbonnier


def solved(
    problem_of: ProblemOf, prior: Prior, config: CodeFitConfig, start: int, w: Float[Tensor, "dimensions"]
) -> Iterator[Step]:
    """From one start, on the rays or points that the seed tells."""
    done, damping, random = 0, config.damping, torch.Generator().manual_seed(config.seed)
    problem: Any = None
    state: Any = None
    for stage, length in stages_of(config.iterations, config.stages):
        if problem is None or stage < 2:
            problem, state = problem_of(random, 1.0 if stage else config.first_share), None
        problem.scale, kernel = config.scale_and_kernel(stage)
        solver = SolverConfig(length, damping, even=True, scale=problem.scale, kernel=kernel, settled=0.0)
        for step, solution in stage_of(problem, w, state, solver, start, done):
            yield step
            done, damping, state, w = step.iteration, solution.damping, solution.state, solution.state.w


def stage_of(
    problem: Any, w: Float[Tensor, "dimensions"], last: Any, solver: SolverConfig, start: int, done: int
) -> Iterator[tuple[Step, Solution]]:
    """A look at all that is compared, and steps from there; the first is charged with the look."""
    began, asked = time.perf_counter(), problem.evaluations
    for solution in minimise(problem.residuals, problem.look(w, last), problem.moved, solver):
        done, state = done + 1, solution.state
        terms, code = problem.terms(state, solution.residuals), problem.prior.code(state.w)
        seconds, evaluations = time.perf_counter() - began, problem.evaluations - asked
        yield Step(start, done, sum(terms.values()), terms, code, seconds, evaluations), solution
        began, asked = time.perf_counter(), problem.evaluations
