"""Fitting a shape's code to observed views by Levenberg–Marquardt: a tenth of Adam's steps, hardly dearer ones."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch

from distrace.code_residuals import Comparison, Problem, Seen
from distrace.data.view import View
from distrace.decoder import Decoder
from distrace.fit import pools_of
from distrace.prior import Prior
from distrace.solver import SolverConfig, charbonnier, minimise
from distrace.starts import Starts, Step, best_of
from distrace.targets import Pool


@dataclass(frozen=True)
class CodeFitConfig(Starts):
    """Steps in stages, each with rays of its own and a smaller scale beyond which residuals count less."""

    iterations: int = 24
    trial: int = 3
    stages: int = 8
    depth_rays: int = 1000  # of each view in each stage
    mask_rays: int = 1500  # few would be fitted for themselves: a code has 256 coordinates
    first_share: float = 0.3  # of them, in the first stage; from the middle on all
    compared: Comparison = Comparison()
    narrowing: float = 0.65  # of the scale, from one stage to the next: at first what is far off is no outlier
    damping: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stages < 1:
            raise ValueError(f"{self.stages} stages were asked for; there must be at least 1")

    @property
    def stage_lengths(self) -> list[int]:
        ends = [self.iterations * stage // self.stages for stage in range(self.stages + 1)]
        return [end - begin for begin, end in pairwise(ends) if end > begin]

    def share_at(self, stage: int) -> float:
        """Of the rays of the silhouette: while all is coarse, a part of them is enough."""
        return min(1.0, self.first_share + (1 - self.first_share) * stage / max(self.stages // 2, 1))

    def compared_at(self, stage: int) -> Comparison:
        return replace(self.compared, scale=self.compared.scale * self.narrowing**stage)


def fit_code(
    decoder: Decoder, views: Sequence[View], prior: Prior, config: CodeFitConfig = CodeFitConfig()
) -> Iterator[Step]:
    """Fits a code to views. Of several starts the one of the least loss goes on; its last step is the result.

    Raises `ValueError` without views, or with one from inside the mean shape.
    """
    pools = pools_of(decoder.field(prior.mean), views, prior.mean.device)
    return best_of(config, lambda start: _solved(decoder, pools, prior, config, start), recent=1)


def _solved(decoder: Decoder, pools: list[Pool], prior: Prior, config: CodeFitConfig, start: int) -> Iterator[Step]:
    """From one start, on the same rays as from the others."""
    began, done, evaluations, damping = time.perf_counter(), 0, 0, config.damping
    rays, w = torch.Generator().manual_seed(config.seed), prior.start(start, config.seed)
    for stage, length in enumerate(config.stage_lengths):
        compared = config.compared_at(stage)
        mask_rays = round(config.mask_rays * config.share_at(stage))
        targets = [pool.draw(config.depth_rays, mask_rays, rays) for pool in pools]
        problem = Problem(decoder, prior, Seen.of(targets, compared.weights), compared)
        solver = SolverConfig(length, damping, even=True, scale=compared.scale, kernel=charbonnier, settled=0.0)
        for solution in minimise(problem.residuals, problem.look(w), problem.moved, solver):
            w, damping, done = solution.state.w, solution.damping, done + 1
            terms = problem.terms(solution.state, solution.residuals)
            seconds, evaluations, before = time.perf_counter() - began, problem.evaluations, evaluations
            yield Step(start, done, sum(terms.values()), terms, prior.code(w), seconds, evaluations - before)
            began = time.perf_counter()
        evaluations = 0
