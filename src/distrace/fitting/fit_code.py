"""Fitting a shape's code by Levenberg–Marquardt, to views or to points: a tenth of Adam's steps, hardly dearer ones."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.view import View
from distrace.decoder import FAR, Decoder
from distrace.field import SDF, Counted
from distrace.fitting.code_residuals import Comparison, Problem
from distrace.fitting.fit import pools_of
from distrace.fitting.nearest import DEPTHS, SILHOUETTE, Hints, first_of
from distrace.fitting.point_residuals import LOOKED, PointProblem, misfit
from distrace.fitting.seen import Seen
from distrace.fitting.solver import Kernel, Solution, SolverConfig, cauchy, charbonnier, minimise
from distrace.fitting.starts import Starts, Step, best_of, by_last_loss, decided, passed, stages_of
from distrace.fitting.targets import drawn
from distrace.fitting.verdict import contradiction
from distrace.losses import Weights
from distrace.prior import Prior
from distrace.rounded import quickest

ProblemOf = Callable[[torch.Generator, float], Problem | PointProblem]
Verdict = Callable[[SDF, Step], float]


@dataclass(frozen=True)
class CodeFitConfig(Starts):
    """Steps in stages, in which deviations beyond a scale count less.

    In the first stages, whose scale narrows, by their absolute values; in the last ones hardly.
    """

    iterations: int = 16
    kept: int = 3  # all of three starts: what a few iterations reach says little about the end
    more: int = 5
    doubtful: float = 0.025  # depths off by that, in radii of the unit sphere, or a quarter of the silhouette
    stages: int = 4
    depth_rays: int = 1000  # of each view
    mask_rays: int = 900  # few would be fitted for themselves: a code has 256 coordinates
    first_share: float = 0.3  # of them, in the first stage: while all is coarse
    sharpening: int = 6  # steps at the end, from the best one, in which …
    outline_rays: int = 600  # … so many rays are to touch the surface
    compared: Comparison = Comparison(Weights(mask=30.0, code=0.05))  # both more than Adam's: docs/from_the_paper.md
    scale: float = 0.02  # at first: what is far off is no outlier …
    narrowing: float = 0.42  # … and × this from one stage to the next
    outlying: float = 0.01  # the scale of the last stages …
    robust: int = 2  # … and how many these are
    damping: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stages < 1 or self.sharpening < 0:
            given = f"{self.stages} stages and {self.sharpening} steps of sharpening"
            raise ValueError(f"{given} were asked for; there must be at least 1 stage")

    @property
    def total(self) -> int:
        """Steps at most: where no silhouette is known it is not sharpened."""
        return super().total + (self.sharpening + 1 if self.sharpening else 0)

    def scale_and_kernel(self, stage: int) -> tuple[float, Kernel]:
        """A stage's scale, and how what is beyond it counts."""
        if stage >= self.stages - self.robust:
            return self.outlying, cauchy
        return self.scale * self.narrowing**stage, charbonnier


def fit_code(
    decoder: Decoder, views: Sequence[View], prior: Prior, config: CodeFitConfig = CodeFitConfig()
) -> Iterator[Step]:
    """Fits a code to views, from several starts; the end that contradicts the views least is taken to their outlines.

    The last step is the result. Raises `ValueError` without views, or with one from inside the mean shape.
    """
    pools = pools_of(decoder.field(prior.mean), views, prior.mean.device)

    def seen(random: torch.Generator, depths: int, silhouette: int, touching: int = 0) -> Seen:
        return Seen.of([pool.draw(depths, silhouette, random, touching) for pool in pools], config.compared.weights)

    def problem(random: torch.Generator, share: float) -> Problem:
        some = seen(random, config.depth_rays, round(config.mask_rays * share))
        return Problem(decoder, prior, some, config.compared)

    others = seen(torch.Generator().manual_seed(config.seed + 1), config.depth_rays, config.mask_rays)

    def verdict(sdf: SDF, step: Step) -> float:
        return contradiction(sdf, others, config.compared.trace)

    random = torch.Generator().manual_seed(config.seed)
    steps = _best(decoder, prior, Hints.of(seen(random, DEPTHS, SILHOUETTE), random), problem, config, verdict)
    if not config.sharpening or not any(len(pool.between) for pool in pools):
        return steps
    random = torch.Generator().manual_seed(config.seed + 2)
    sharp = seen(random, config.depth_rays, config.mask_rays // 2, config.outline_rays)
    return _then_sharpened(steps, Problem(decoder, prior, sharp, config.compared), config, verdict)


def _then_sharpened(steps: Iterator[Step], problem: Problem, config: CodeFitConfig, verdict: Verdict) -> Iterator[Step]:
    """Steps, and from where they end others that bring the surface to the outline itself; the better end comes last.

    From farther away such rays, which pull from both sides, lead to other ends more often than they help.
    """
    best = yield from passed(steps)
    step, problem.scale, w = best, config.outlying, problem.prior.coordinates(best.code)
    solver = SolverConfig(config.sharpening, config.damping, even=True, scale=problem.scale, settled=0.0)
    for step, _ in _stage(problem, w, None, solver, best.start, best.iteration):
        yield step
    yield decided([_judged(problem.decoder, verdict, end) for end in (best, step)])


def fit_points(
    decoder: Decoder, samples: Float[Tensor, "n 4"], prior: Prior, config: CodeFitConfig = CodeFitConfig()
) -> Iterator[Step]:
    """Fits a code to points and their signed distances, which are 0 on the surface, as `fit_code` does to views.

    The end that is nearest to all of them is the last step again. A list of distances should tell where nothing is,
    too: points far from the surface are compared only where a fit has come too near to them.

    Raises `ValueError` without points.
    """
    if not len(samples):
        raise ValueError("no points were given; fitting needs points with their signed distances")

    def problem(random: torch.Generator, share: float) -> PointProblem:
        count = config.depth_rays + round(config.mask_rays * share)
        return PointProblem(decoder, prior, samples, count, random, weights)

    def verdict(sdf: SDF, step: Step) -> float:
        return weights.depth * misfit(sdf, others) + step.terms["code"]

    random, weights = torch.Generator().manual_seed(config.seed), config.compared.weights
    near = samples[samples[:, 3].abs() < FAR]
    some = drawn(near if len(near) else samples, DEPTHS + SILHOUETTE, random)  # others say less of which shape it is
    others = drawn(samples, LOOKED, torch.Generator().manual_seed(config.seed + 1))
    return _best(decoder, prior, Hints(some[:, :3], some[:, 3]), problem, replace(config, more=0), verdict)


def _best(
    decoder: Decoder,
    prior: Prior,
    hints: Hints,
    problem_of: ProblemOf,
    config: CodeFitConfig,
    verdict: Verdict,
) -> Iterator[Step]:
    """From all starts; the first step is charged with the search for them. The least verdict's end is the best."""
    first = first_of(decoder, prior, hints, config.most, config.seed)

    def run(start: int) -> Iterator[Step]:
        return _solved(problem_of, prior, config, start, first.coordinates[start])

    steps = best_of(config, run, by_last_loss, partial(_judged, decoder, verdict))
    step = next(steps)
    yield replace(step, seconds=step.seconds + first.seconds, evaluations=step.evaluations + first.evaluations)
    yield from steps


def _judged(decoder: Decoder, verdict: Verdict, step: Step) -> Step:
    """A step with the verdict on its shape, and what that took: nothing, where it has one."""
    if isfinite(step.verdict):
        return replace(step, seconds=0.0, evaluations=0)
    began, sdf = time.perf_counter(), Counted(quickest(decoder).field(step.code))
    judged = replace(step, verdict=verdict(sdf, step))
    return replace(judged, seconds=time.perf_counter() - began, evaluations=sdf.evaluations)


def _solved(
    problem_of: ProblemOf, prior: Prior, config: CodeFitConfig, start: int, w: Float[Tensor, "dimensions"]
) -> Iterator[Step]:
    """From one start, on the same rays or points as from the others."""
    done, damping, random = 0, config.damping, torch.Generator().manual_seed(config.seed)
    problem: Any = None
    state: Any = None
    for stage, length in stages_of(config.iterations, config.stages):
        if problem is None or stage < 2:
            problem, state = problem_of(random, 1.0 if stage else config.first_share), None
        problem.scale, kernel = config.scale_and_kernel(stage)
        solver = SolverConfig(length, damping, even=True, scale=problem.scale, kernel=kernel, settled=0.0)
        for step, solution in _stage(problem, w, state, solver, start, done):
            yield step
            done, damping, state, w = step.iteration, solution.damping, solution.state, solution.state.w


def _stage(
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
