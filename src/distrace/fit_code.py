"""Fitting a shape's code to observed views by Levenberg–Marquardt: a tenth of Adam's steps, hardly dearer ones."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise

import torch

from distrace.code_residuals import Comparison, Problem, Seen
from distrace.data.view import View
from distrace.decoder import Decoder
from distrace.fit import Prior, Step
from distrace.solver import SolverConfig, charbonnier, minimise
from distrace.targets import Pool

DEVIATION = 0.7  # of the prior's, in draws of starts


@dataclass(frozen=True)
class CodeFitConfig:
    """Steps in stages, each with rays of its own and a smaller scale beyond which residuals count less."""

    iterations: int = 18
    stages: int = 6
    depth_rays: int = 1000  # of each view in each stage
    mask_rays: int = 1500  # few would be fitted for themselves: a code has 256 coordinates
    compared: Comparison = Comparison()
    narrowing: float = 0.7  # of the scale, from one stage to the next: at first what is far off is no outlier
    damping: float = 0.1
    starts: int = 3
    trial: int = 3  # iterations that every start is given before the best goes on alone
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.iterations, self.stages, self.starts) < 1:
            given = f"{self.iterations} iterations in {self.stages} stages from {self.starts} starts"
            raise ValueError(f"{given} were asked for; each must be at least 1")

    @property
    def tried(self) -> int:
        """Iterations of each start before the choice; the best has at least one left to go on."""
        return min(self.trial, self.iterations - 1) if self.starts > 1 else 0

    @property
    def total(self) -> int:
        return self.iterations + self.tried * (self.starts - 1)

    @property
    def stage_lengths(self) -> list[int]:
        ends = [self.iterations * stage // self.stages for stage in range(self.stages + 1)]
        return [end - begin for begin, end in pairwise(ends) if end > begin]

    def compared_at(self, stage: int) -> Comparison:
        return replace(self.compared, scale=self.compared.scale * self.narrowing**stage)


def fit_code(
    decoder: Decoder, views: Sequence[View], prior: Prior, config: CodeFitConfig = CodeFitConfig()
) -> Iterator[Step]:
    """Fits a code to views. Of several starts the one of the least loss goes on; its last step is the result.

    Raises `ValueError` without views.
    """
    if not views:
        raise ValueError("no view was given; fitting needs at least one")
    pools = [Pool.of(view) for view in views]
    runs, trials = [], []
    for start in range(config.starts):
        runs.append(_solved(decoder, pools, prior, config, start))
        steps = list(islice(runs[-1], config.tried))
        yield from steps
        trials += steps[-1:]
    best = min(trials, key=lambda step: step.loss) if trials else None
    run = runs[best.start if best else 0]
    following = next(run, None) or (best and replace(best, seconds=0.0, evaluations=0))  # it may have settled
    assert following is not None, "every run has a step"
    yield following
    yield from run


def _solved(decoder: Decoder, pools: list[Pool], prior: Prior, config: CodeFitConfig, start: int) -> Iterator[Step]:
    """From one start, on the same rays as from the others: the mean shape first, then draws from the prior."""
    began, done, evaluations, damping = time.perf_counter(), 0, 0, config.damping
    random, rays = (torch.Generator().manual_seed(seed) for seed in (config.seed + start, config.seed))
    w = (torch.randn(prior.basis.shape[1], generator=random) * (DEVIATION if start else 0.0)).to(prior.mean)
    for stage, length in enumerate(config.stage_lengths):
        compared = config.compared_at(stage)
        targets = [pool.draw(config.depth_rays, config.mask_rays, rays) for pool in pools]
        problem = Problem(decoder, prior, Seen.of(targets, compared.weights), compared)
        solver = SolverConfig(length, damping, compared.scale, kernel=charbonnier, settled=0.0)
        for solution in minimise(problem.residuals, problem.look(w), problem.moved, solver):
            w, damping, done = solution.state.w, solution.damping, done + 1
            terms = problem.terms(solution.state, solution.residuals)
            seconds, evaluations, before = time.perf_counter() - began, problem.evaluations, evaluations
            yield Step(start, done, sum(terms.values()), terms, prior.code(w), seconds, evaluations - before)
            began = time.perf_counter()
        evaluations = 0
