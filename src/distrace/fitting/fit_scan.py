"""Fits a code and a placement to a scan, by Levenberg–Marquardt from many starts, of which ever fewer go on.

Points and rays are compared as they are, without tracing; robustly, so that points of other things do not count.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf

import torch
from torch import Tensor
from torch.nn.functional import pad

from distrace.data.scan import Scan
from distrace.fields.decoder import Decoder
from distrace.fields.precision import fastest
from distrace.fitting.judge import Verdict, disagreement_of, judged, surface_points
from distrace.fitting.proposals import proposed, proposed_codes
from distrace.fitting.scan_residuals import PlacedCode, ScanProblem, ScanSample, Start
from distrace.fitting.solver import Descent, SolverConfig, descend, geman_mcclure
from distrace.pose import Similarity
from distrace.prior import Prior

JUDGED_POINTS = 500
EQUAL = 0.15  # of the least loss: an end that is no worse by more may be right as well


@dataclass(frozen=True)
class Round:
    """Some iterations of several starts."""

    starts: int  # the best ones of the round before
    iterations: int
    dimensions: int  # leading coordinates of the code
    points: int
    rays: int
    samples: int  # on each ray
    deviation: float  # of the shape from the scan, in radii of the scan


@dataclass(frozen=True)
class ScanFitConfig:
    """The rounds of a fit, coarse to fine."""

    rounds: tuple[Round, ...] = (
        Round(16, 7, 32, 100, 80, 6, 0.06),
        Round(5, 7, 64, 250, 150, 8, 0.03),
        Round(2, 10, 256, 500, 300, 10, 0.015),
    )
    seed: int = 0

    @property
    def total(self) -> int:
        """Iterations of all rounds."""
        return sum(each.iterations for each in self.rounds)


@dataclass(frozen=True)
class ScanFit:
    """The code and the placement that explain a scan best, and the verdict on them."""

    code: Tensor
    place: Similarity
    loss: float
    verdict: Verdict
    losses: dict[str, list[float]]  # of each start that reached the last round
    evaluations: int
    seconds: float
    others: tuple[tuple[Tensor, Similarity], ...]  # ends that are nearly as good


def fit_scan(
    decoder: Decoder,
    scan: Scan,
    prior: Prior,
    config: ScanFitConfig = ScanFitConfig(),
    place: Similarity | None = None,
) -> Iterator[int | ScanFit]:
    """Yields the number of iterations that are done, and at last the fit. A `place` that is given is kept."""
    began = time.perf_counter()
    quick = fastest(decoder)
    random = torch.Generator().manual_seed(config.seed)
    count = config.rounds[0].starts
    if place is None:
        states = proposed(scan, quick, prior, count, config.seed)
    else:
        states = proposed_codes(scan, place, quick, prior, count, config.seed)
    starts = [_likely(state, scan) for state in states]
    losses: list[list[float]] = [[] for _ in states]
    evaluations = 0
    done = 0
    ends: list[tuple[float, PlacedCode]] = [(0.0, state) for state in states]
    for stage in config.rounds:
        sample = ScanSample.drawn(scan, stage.points, stage.rays, random)
        deviation = (stage.deviation**2 * scan.radius**2 + scan.noise**2) ** 0.5
        problem = ScanProblem(quick, prior, sample, deviation, starts, scan.tilt, stage.samples, place is None)
        dimensions = min(stage.dimensions, prior.basis.shape[1])
        begins = [_widened(state, dimensions) for _, state in ends[: stage.starts]]
        descents = [Descent(*each, 1e-2) for each in zip(begins, problem.residuals(begins), strict=True)]
        solver = SolverConfig(stage.iterations, kernel=geman_mcclure, settled=1e-3)
        for iteration in range(stage.iterations):
            going = [descent for descent in descents if not descent.settled]
            if going:
                descend(going, problem.residuals, problem.retract, solver, iteration)
            for descent in descents:
                losses[descent.state.start].append(descent.residuals.loss(1.0, geman_mcclure))
            done += 1
            yield done
        evaluations += sum(problem.evaluations.values())
        ends = sorted(((_loss(descent), descent.state) for descent in descents), key=lambda end: end[0])
    yield _fitted(decoder, scan, prior, ends, losses, evaluations, began)


def _fitted(
    decoder: Decoder,
    scan: Scan,
    prior: Prior,
    ends: Sequence[tuple[float, PlacedCode]],
    losses: Sequence[Sequence[float]],
    evaluations: int,
    began: float,
) -> ScanFit:
    least, best = ends[0]
    codes = [state.code(prior) for _, state in ends]
    sdf = decoder.field(codes[0])
    equal = [k for k, (loss, _) in enumerate(ends) if k and loss <= (1 + EQUAL) * least]
    others = tuple((codes[k], ends[k][1].place) for k in equal)
    surface = best.place.to_world(surface_points(sdf, JUDGED_POINTS, scan.points))
    disagreement = disagreement_of(surface, best.place, [(decoder.field(code), place) for code, place in others])
    verdict = judged(scan, sdf, best.place, disagreement)
    curves = {f"start {state.start + 1}": list(losses[state.start]) for _, state in ends}
    return ScanFit(codes[0], best.place, least, verdict, curves, evaluations, time.perf_counter() - began, others)


def _likely(state: PlacedCode, scan: Scan) -> Start:
    """Returns what is likely where a start ends: its size, and the candidate of up that it began with."""
    axis = state.place.rotation[:, 1]
    up = scan.ups[(scan.ups @ axis).argmax()] if len(scan.ups) else None
    return Start(float(state.place.scale), up)


def _widened(state: PlacedCode, dimensions: int) -> PlacedCode:
    """Returns a state with more coordinates, which are zero, or fewer."""
    return replace(state, w=pad(state.w, (0, dimensions - len(state.w))))


def _loss(descent: Descent[PlacedCode]) -> float:
    return descent.residuals.loss(1.0, geman_mcclure) if descent.residuals.values.isfinite().all() else inf
