"""Fits of a code from several starts at once, in stages: what is far off pulls at first, and hardly in the end."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fitting.code_residuals import Comparison, Problem
from distrace.fitting.multistart import Starts, Step, stages_of
from distrace.fitting.point_residuals import PointProblem
from distrace.fitting.solver import Descent, Kernel, SolverConfig, cauchy, charbonnier, descend
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


def fitted(
    problem_of: ProblemOf, prior: Prior, config: CodeFitConfig, w: Sequence[Float[Tensor, "dimensions"]], first: int = 0
) -> list[list[Step]]:
    """All steps of fits from several starts `w`, numbered from `first`, on the rays or points that the seed tells.

    Each ends where it would end alone; the network is evaluated for all of them together.
    """
    steps: list[list[Step]] = [[] for _ in w]
    random, damping = torch.Generator().manual_seed(config.seed), [config.damping] * len(w)
    problem: Any = None
    last: Any = None
    for stage, length in stages_of(config.iterations, config.stages):
        if problem is None or stage < 2:
            problem, last = problem_of(random, 1.0 if stage else config.first_share), None
        problem.scale, kernel = config.scale_and_kernel(stage)
        solver = SolverConfig(length, even=True, scale=problem.scale, kernel=kernel, settled=0.0)
        done = [(first + k, len(before)) for k, before in enumerate(steps)]
        more, descents = stage_of(problem, w, last, solver, damping, done)
        steps = [before + after for before, after in zip(steps, more, strict=True)]
        last, damping = [each.state for each in descents], [each.damping for each in descents]
        w = [state.w for state in last]
    return steps


def stage_of(
    problem: Any,
    w: Sequence[Float[Tensor, "dimensions"]],
    last: Any,
    solver: SolverConfig,
    damping: Sequence[float],
    done: Sequence[tuple[int, int]],
) -> tuple[list[list[Step]], list[Descent]]:
    """Looks along all rays, and steps from there, of several starts: their steps, and where they end.

    `done`: each start's number, and how many steps it has had. The first step is charged with the look. Time is shared
    out evenly; a start that has settled takes no further part.
    """
    began, evaluations = time.perf_counter(), Counter(problem.evaluations)
    looks = problem.look(w, last)
    descents = [Descent(*each) for each in zip(looks, problem.residuals(looks), damping, strict=True)]
    steps: list[list[Step]] = [[] for _ in w]
    for iteration in range(solver.iterations):
        going = [k for k, descent in enumerate(descents) if not descent.settled]
        if not going:
            break
        descend([descents[k] for k in going], problem.residuals, problem.moved, solver, iteration)
        seconds, began = (time.perf_counter() - began) / len(going), time.perf_counter()
        spent, evaluations = problem.evaluations - evaluations, Counter(problem.evaluations)
        for k in going:
            (start, before), state = done[k], descents[k].state
            terms, code = problem.terms(state, descents[k].residuals), problem.prior.code(state.w)
            number = before + len(steps[k]) + 1
            steps[k].append(Step(start, number, sum(terms.values()), terms, code, seconds, spent[k]))
    return steps, descents
