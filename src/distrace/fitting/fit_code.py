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

from distrace.data.view import View
from distrace.decoder import FAR, Decoder
from distrace.field import SDF, Counted
from distrace.fitting.code_residuals import Problem
from distrace.fitting.fit import pools_of
from distrace.fitting.nearest import DEPTHS, SILHOUETTE, Hints, first_of
from distrace.fitting.noise_level import noise_of
from distrace.fitting.point_residuals import LOOKED, PointProblem, misfit
from distrace.fitting.seen import Seen
from distrace.fitting.side_by_side import Fields, Groups
from distrace.fitting.solver import SolverConfig
from distrace.fitting.staged import CodeFitConfig, ProblemOf, solved, stage_of
from distrace.fitting.starts import Step, best_of, by_last_loss, decided, ended
from distrace.fitting.targets import drawn
from distrace.fitting.verdict import contradiction
from distrace.prior import Prior

Verdict = Callable[[SDF, Step], float]


def fit_code(
    decoder: Decoder, views: Sequence[View], prior: Prior, config: CodeFitConfig = CodeFitConfig()
) -> Iterator[Step]:
    """Fits a code to views, from several starts; the ends that contradict the views least are taken to their outlines.

    The last step is the result. Raises `ValueError` without views, or with one from inside the mean shape.
    """
    pools = pools_of(decoder.field(prior.mean), views, prior.mean.device)
    noises, fields = [noise_of(view) for view in views], Fields(decoder)

    def seen(random: torch.Generator, depths: int, silhouette: int, touching: int = 0) -> Seen:
        targets = [pool.draw(depths, silhouette, random, touching) for pool in pools]
        return Seen.of(targets, config.compared.weights, noises)

    def problem(random: torch.Generator, share: float) -> Problem:
        some = seen(random, config.depth_rays, round(config.mask_rays * share))
        return Problem(fields, prior, some, config.compared)

    others = seen(torch.Generator().manual_seed(config.seed + 1), config.depth_rays, config.mask_rays)

    def verdict(sdf: SDF, step: Step) -> float:
        return contradiction(sdf, others, config.compared.trace)

    random = torch.Generator().manual_seed(config.seed)
    hints = Hints.of(seen(random, DEPTHS, SILHOUETTE), random)
    few = hints.depths < DEPTHS  # they hardly tell which training shapes are near
    config = config if few else replace(config, hops=0, sharpened=1)
    steps = _best(fields, prior, hints, problem, config, verdict)
    if not config.sharpening or not any(len(pool.between) for pool in pools):
        return steps
    random = torch.Generator().manual_seed(config.seed + 2)
    sharp = seen(random, config.depth_rays, config.mask_rays // 2, config.outline_rays)
    return _then_sharpened(steps, Problem(fields, prior, sharp, config.compared, config.outlying), config, verdict)


def _then_sharpened(steps: Iterator[Step], problem: Problem, config: CodeFitConfig, verdict: Verdict) -> Iterator[Step]:
    """Steps, and from the best of their ends others that bring the surface to the outline; the best end comes last.

    From farther away such rays, which pull from both sides, lead to other ends more often than they help.
    """
    ends: dict[int, Step] = {}
    for step in steps:
        yield step
        if isfinite(step.verdict):
            ends[step.start] = step
    best = sorted(ends.values(), key=lambda end: end.verdict)[: config.sharpened]
    # each with a problem of its own: it counts its own evaluations
    sharper = problem.fields.side_by_side([_sharpened(end, replace(problem), config) for end in best])
    yield from chain.from_iterable(sharper)
    last = [*best, *(fit[-1] for fit in sharper)]
    yield decided([_judged(problem.fields, verdict, end) for end in last])


def _sharpened(end: Step, problem: Problem, config: CodeFitConfig) -> Iterator[Step]:
    solver = SolverConfig(config.sharpening, config.damping, even=True, scale=problem.scale, settled=0.0)
    steps = stage_of(problem, problem.prior.coordinates(end.code), None, solver, end.start, end.iteration)
    return (step for step, _ in steps)


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
    return _best(
        Fields(decoder), prior, Hints(some[:, :3], some[:, 3]), problem, replace(config, more=0, hops=0), verdict
    )


def _best(
    fields: Fields,
    prior: Prior,
    hints: Hints,
    problem_of: ProblemOf,
    config: CodeFitConfig,
    verdict: Verdict,
) -> Iterator[Step]:
    """From all starts; the first step is charged with the search for them. The least verdict's end is the best.

    While none fits it hops from the best one and looks at other rays (basin hopping: Wales and Doye,
    *J. Phys. Chem. A* 1997).
    """
    first, judge = first_of(fields.quick, prior, hints, config.apart, config.seed), partial(_judged, fields, verdict)

    def fit(start: int) -> Iterator[Step]:
        return ended(solved(problem_of, prior, config, start, first.coordinates[start]), judge)

    def hop(start: int, best: Step) -> Iterator[Step]:
        other = replace(config, seed=config.seed + start)
        away = prior.draw(torch.Generator().manual_seed(other.seed), config.hop)
        return ended(solved(problem_of, prior, other, start, prior.coordinates(best.code) + away), judge)

    groups = Groups(fields, fit, [range(config.starts), range(config.starts, config.apart)])
    steps = ended(best_of(config, groups.steps, by_last_loss, judge, hop), groups.charge)
    step = next(steps)
    yield replace(step, seconds=step.seconds + first.seconds, evaluations=step.evaluations + first.evaluations)
    yield from steps


def _judged(fields: Fields, verdict: Verdict, step: Step) -> Step:
    """A step with the verdict on its shape, and what that took: nothing, where it has one."""
    if isfinite(step.verdict):
        return replace(step, seconds=0.0, evaluations=0)
    began, sdf = time.perf_counter(), Counted(fields.field(step.code))
    judged = replace(step, verdict=verdict(sdf, step))
    return replace(judged, seconds=time.perf_counter() - began, evaluations=sdf.evaluations)
