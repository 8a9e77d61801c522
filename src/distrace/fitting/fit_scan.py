"""Fits a code and a placement to a scan, by Levenberg–Marquardt from several starts, of which the best go on.

Points and rays are compared as they are, without tracing; robustly, so that points of other things do not count.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from distrace.data.scan import Scan
from distrace.fields.decoder import Decoder
from distrace.fields.precision import fastest
from distrace.fitting.judge import Verdict, judged
from distrace.fitting.placement_network import PlacementNetwork
from distrace.fitting.rounds import Ends, Progress, Round, run_rounds
from distrace.fitting.scan_residuals import PlacedCode, PlacementPrior, ScanProblem, ScanSample
from distrace.fitting.scan_starts import Starts, find_starts, placement_prior
from distrace.fitting.solver import SolverConfig, charbonnier
from distrace.pose import Similarity
from distrace.prior import Prior

SOLVER = SolverConfig(damping=1e-2, settled=1e-3)
SCREENING = Round(0, 0, 0, 60, 60, 4, 0.06, charbonnier)  # compares more states than the first round takes
EQUAL = 0.15  # of the least loss: an end that is no worse by more may be right as well


@dataclass(frozen=True)
class ScanFitConfig:
    """The rounds of a fit, coarse to fine."""

    rounds: tuple[Round, ...] = (
        Round(16, 6, 32, 100, 80, 6, 0.06, charbonnier),
        Round(2, 12, 256, 400, 250, 10, 0.015),
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

    def _repr_html_(self) -> str:
        """Returns what Jupyter shows."""
        from distrace import notebook

        verdict = f"{self.verdict.name}: {self.verdict.reason}"
        facts = {"loss": self.loss, "evaluations": self.evaluations, "seconds": self.seconds}
        return notebook.table("ScanFit", {**facts, "verdict": verdict})


def fit_scan(
    decoder: Decoder,
    scan: Scan,
    prior: Prior,
    config: ScanFitConfig = ScanFitConfig(),
    place: Similarity | None = None,
    progress: Progress | None = None,
    start: PlacedCode | None = None,
    network: PlacementNetwork | None = None,
) -> ScanFit:
    """Fits code and placement. A `place` that is given is kept; a `start` is the only one.

    The model's `network`, where it has one, says where to start; otherwise places all about the scan are tried.
    """
    began = time.perf_counter()
    quick = fastest(decoder)
    random = torch.Generator().manual_seed(config.seed)

    def problem_of(stage: Round, placement_priors: Sequence[PlacementPrior]) -> ScanProblem:
        sample = ScanSample.drawn(scan, stage.points, stage.rays, random)
        deviation = (stage.deviation**2 * scan.radius**2 + scan.noise**2) ** 0.5
        return ScanProblem(
            quick,
            prior,
            sample,
            deviation,
            placement_priors,
            scan.tilt,
            stage.samples,
            place is None,
            margin=stage.margin,
        )

    if start is None:
        starts = find_starts(scan, prior, quick, network, place, partial(problem_of, SCREENING), config.seed)
    else:
        starts = Starts([start], [placement_prior(start.place, scan)])
    ends = run_rounds(
        starts.states, config.rounds, partial(problem_of, placement_priors=starts.placement_priors), SOLVER, progress
    )
    return _fitted(decoder, scan, prior, starts, ends, began)


def _fitted(decoder: Decoder, scan: Scan, prior: Prior, starts: Starts, ends: Ends, began: float) -> ScanFit:
    least, best = ends.losses[0], ends.states[0]
    codes = [state.code(prior) for state in ends.states]
    sdf = decoder.field(codes[0])
    equal = [k for k, loss in enumerate(ends.losses) if k and loss <= (1 + EQUAL) * least]
    others = tuple((codes[k], ends.states[k].place) for k in equal)
    placed = [(decoder.field(code), place) for code, place in others]
    deviation = starts.placement_priors[best.start].prior_deviation(best.place)
    verdict = judged(scan, sdf, best.place, placed, prior_deviation=deviation)
    evaluations = starts.evaluations + ends.evaluations
    seconds = time.perf_counter() - began
    return ScanFit(codes[0], best.place, least, verdict, ends.curves, evaluations, seconds, others)
