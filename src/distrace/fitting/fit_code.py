"""Fitting a shape's code by Levenberg–Marquardt, to views or to points: a tenth of Adam's steps, hardly dearer ones."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from math import isfinite

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.observation import View
from distrace.fields.batch import CountedBatch
from distrace.fields.decoder import FAR, Decoder
from distrace.fields.precision import BFloat16Decoder, fastest
from distrace.fitting.code_residuals import Problem
from distrace.fitting.continuation import CodeFitConfig, ProblemOf, fitted, stage_of
from distrace.fitting.fit import pools_of
from distrace.fitting.multistart import Step, best_of, by_last_loss, charged, decided
from distrace.fitting.noise_estimation import noise_of
from distrace.fitting.observations import Seen
from distrace.fitting.point_residuals import LOOKED, PointProblem, misfits
from distrace.fitting.ray_sampling import drawn
from distrace.fitting.retrieval import DEPTHS, SILHOUETTE, Hints, first_of
from distrace.fitting.solver import SolverConfig
from distrace.fitting.verdict import contradictions
from distrace.prior import Prior

Verdicts = Callable[[CountedBatch, Sequence[Step]], list[float]]
"""Of the shapes of several steps, which have a field together."""
Judge = Callable[[Sequence[Step]], list[Step]]
"""From steps to those with a verdict, and with the time and the evaluations that this took."""


def fit_code(
    decoder: Decoder, views: Sequence[View], prior: Prior, config: CodeFitConfig = CodeFitConfig()
) -> Iterator[Step]:
    """Fits a code to views, from several starts; the ends that contradict the views least are taken to their outlines.

    The last step is the result. Raises `ValueError` without views, or with one from inside the mean shape.
    """
    pools = pools_of(decoder.field(prior.mean), views, prior.mean.device)
    noises, quick = [noise_of(view) for view in views], fastest(decoder)

    def seen(random: torch.Generator, depths: int, silhouette: int, touching: int = 0) -> Seen:
        targets = [pool.draw(depths, silhouette, random, touching) for pool in pools]
        return Seen.of(targets, config.compared.weights, noises)

    def problem(random: torch.Generator, share: float) -> Problem:
        some = seen(random, config.depth_rays, round(config.mask_rays * share))
        return Problem(quick, prior, some, config.compared)

    others = seen(torch.Generator().manual_seed(config.seed + 1), config.depth_rays, config.mask_rays)

    def verdicts(field: CountedBatch, steps: Sequence[Step]) -> list[float]:
        return contradictions(field, others, config.compared.trace)

    random = torch.Generator().manual_seed(config.seed)
    hints = Hints.of(seen(random, DEPTHS, SILHOUETTE), random)
    few = hints.depths < DEPTHS  # they hardly tell which training shapes are near
    config = config if few else replace(config, hops=0, sharpened=1)
    judge = partial(_judged, quick, verdicts)
    steps = _best(quick, prior, hints, problem, config, judge)
    if not config.sharpening or not any(len(pool.between) for pool in pools):
        return steps
    random = torch.Generator().manual_seed(config.seed + 2)
    sharp = seen(random, config.depth_rays, config.mask_rays // 2, config.outline_rays)
    return _then_sharpened(steps, Problem(quick, prior, sharp, config.compared, config.outlying), config, judge)


def _then_sharpened(steps: Iterator[Step], problem: Problem, config: CodeFitConfig, judge: Judge) -> Iterator[Step]:
    """Steps, and from the best of their ends others that bring the surface to the outline; the best end comes last.

    From farther away such rays, which pull from both sides, lead to other ends more often than they help.
    """
    ends: dict[int, Step] = {}
    for step in steps:
        yield step
        if isfinite(step.verdict):
            ends[step.start] = step
    best = sorted(ends.values(), key=lambda end: end.verdict)[: config.sharpened]
    solver = SolverConfig(config.sharpening, even=True, scale=problem.scale, settled=0.0)
    w, done = [problem.prior.coordinates(end.code) for end in best], [(end.start, end.iteration) for end in best]
    sharper, _ = stage_of(problem, w, None, solver, [config.damping] * len(best), done)
    yield from chain.from_iterable(sharper)
    yield decided(judge([*best, *(fit[-1] for fit in sharper)]))


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

    def verdicts(field: CountedBatch, steps: Sequence[Step]) -> list[float]:
        found = misfits(field, others)
        return [weights.depth * misfit + step.terms["code"] for misfit, step in zip(found, steps, strict=True)]

    random, weights = torch.Generator().manual_seed(config.seed), config.compared.weights
    near = samples[samples[:, 3].abs() < FAR]
    some = drawn(near if len(near) else samples, DEPTHS + SILHOUETTE, random)  # others say less of which shape it is
    others = drawn(samples, LOOKED, torch.Generator().manual_seed(config.seed + 1))
    hints, quick = Hints(some[:, :3], some[:, 3]), fastest(decoder)
    return _best(quick, prior, hints, problem, replace(config, more=0, hops=0), partial(_judged, quick, verdicts))


def _best(
    decoder: Decoder | BFloat16Decoder,
    prior: Prior,
    hints: Hints,
    problem_of: ProblemOf,
    config: CodeFitConfig,
    judge: Judge,
) -> Iterator[Step]:
    """From all starts; the first step is charged with the search for them. The least verdict's end is the best.

    The first starts are fitted together, and so are those that follow while none fits. Then each hops from the best
    one and looks at other rays (basin hopping: Wales and Doye, *J. Phys. Chem. A* 1997).
    """
    first = first_of(decoder, prior, hints, config.apart, config.seed)
    fits: dict[int, list[Step]] = {}
    wanted: set[int] = set()

    def fit(starts: range, w: Sequence[Float[Tensor, "dimensions"]], seed: int) -> None:
        steps = fitted(problem_of, prior, replace(config, seed=seed), w, starts[0])
        judged = judge([each[-1] for each in steps])
        for start, each, end in zip(starts, steps, judged, strict=True):
            fits[start] = [*each[:-1], charged(end, [each[-1]])]

    def run(start: int) -> Iterator[Step]:
        if start not in fits:
            group = range(config.starts) if start < config.starts else range(config.starts, config.apart)
            fit(group, first.coordinates[group[0] : group[-1] + 1], config.seed)
        wanted.add(start)
        return iter(fits[start])

    def hop(start: int, best: Step) -> Iterator[Step]:
        seed = config.seed + start
        away = prior.draw(torch.Generator().manual_seed(seed), config.hop)
        fit(range(start, start + 1), [prior.coordinates(best.code) + away], seed)
        return run(start)

    steps = best_of(config, run, by_last_loss, lambda step: judge([step])[0], hop)
    step = next(steps)
    step = replace(step, seconds=step.seconds + first.seconds, evaluations=step.evaluations + first.evaluations)
    for following in steps:
        yield step
        step = following
    yield charged(step, [each for start, in_vain in fits.items() if start not in wanted for each in in_vain])


def _judged(decoder: Decoder | BFloat16Decoder, verdicts: Verdicts, steps: Sequence[Step]) -> list[Step]:
    """Steps with the verdicts on their shapes, and what those took: nothing, for a step that has one."""
    began, new = time.perf_counter(), [step for step in steps if not isfinite(step.verdict)]
    if not new:
        return [replace(step, seconds=0.0, evaluations=0) for step in steps]
    field = CountedBatch(decoder.fields(torch.stack([step.code for step in new])))
    found = verdicts(field, new)
    seconds = (time.perf_counter() - began) / len(new)
    each = zip(new, found, field.evaluations, strict=True)
    judged = {id(step): replace(step, verdict=v, seconds=seconds, evaluations=spent) for step, v, spent in each}
    return [judged.get(id(step)) or replace(step, seconds=0.0, evaluations=0) for step in steps]
