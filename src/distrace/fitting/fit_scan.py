"""Fits a code and a placement to a scan, by Levenberg–Marquardt from many starts, of which ever fewer go on.

Points and rays are compared as they are, without tracing; robustly, so that points of other things do not count.
"""

import time
from dataclasses import dataclass

import torch
from torch import Tensor

from distrace.data.scan import Scan
from distrace.fields.decoder import Decoder
from distrace.fields.precision import fastest
from distrace.fitting.judge import Verdict, judged
from distrace.fitting.proposals import proposed, proposed_codes
from distrace.fitting.rounds import Ends, Progress, Round, run_rounds
from distrace.fitting.scan_residuals import PlacedCode, ScanProblem, ScanSample, Start
from distrace.fitting.solver import SolverConfig, charbonnier
from distrace.pose import Similarity
from distrace.prior import Prior

SOLVER = SolverConfig(damping=1e-2, settled=1e-3)
EQUAL = 0.15  # of the least loss: an end that is no worse by more may be right as well


@dataclass(frozen=True)
class ScanFitConfig:
    """The rounds of a fit, coarse to fine."""

    rounds: tuple[Round, ...] = (
        Round(16, 7, 32, 100, 80, 6, 0.06, charbonnier),
        Round(5, 7, 64, 250, 150, 8, 0.03),
        Round(3, 10, 256, 500, 300, 10, 0.015),
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
) -> ScanFit:
    """Fits code and placement. A `place` that is given is kept; a `start` is the only one."""
    began = time.perf_counter()
    quick = fastest(decoder)
    random = torch.Generator().manual_seed(config.seed)
    count = config.rounds[0].starts
    if start is not None:
        states = [start]
    elif place is None:
        states = proposed(scan, quick, prior, count, config.seed)
    else:
        states = proposed_codes(scan, place, quick, prior, count, config.seed)
    starts = [_likely(state, scan) for state in states]

    def problem_of(stage: Round) -> ScanProblem:
        sample = ScanSample.drawn(scan, stage.points, stage.rays, random)
        deviation = (stage.deviation**2 * scan.radius**2 + scan.noise**2) ** 0.5
        return ScanProblem(
            quick, prior, sample, deviation, starts, scan.tilt, stage.samples, place is None, margin=stage.margin
        )

    ends = run_rounds(states, config.rounds, problem_of, SOLVER, progress)
    return _fitted(decoder, scan, prior, ends, began)


def _fitted(decoder: Decoder, scan: Scan, prior: Prior, ends: Ends, began: float) -> ScanFit:
    least, best = ends.losses[0], ends.states[0]
    codes = [state.code(prior) for state in ends.states]
    sdf = decoder.field(codes[0])
    equal = [k for k, loss in enumerate(ends.losses) if k and loss <= (1 + EQUAL) * least]
    others = tuple((codes[k], ends.states[k].place) for k in equal)
    verdict = judged(scan, sdf, best.place, [(decoder.field(code), place) for code, place in others])
    seconds = time.perf_counter() - began
    return ScanFit(codes[0], best.place, least, verdict, ends.curves, ends.evaluations, seconds, others)


def _likely(state: PlacedCode, scan: Scan) -> Start:
    """Returns what is likely where a start ends: its size, and the candidate of up that it began with."""
    axis = state.place.rotation[:, 1]
    up = scan.ups[(scan.ups @ axis).argmax()] if len(scan.ups) else None
    return Start(float(state.place.scale), up)
