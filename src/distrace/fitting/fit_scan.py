"""Fits a code and a placement to a scan, by Levenberg–Marquardt from several starts, of which the best go on.

Points and rays are compared as they are, without tracing; robustly, so that points of other things do not count.
"""

import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from distrace.data.scan import Scan
from distrace.fields.decoder import Decoder
from distrace.fields.precision import BFloat16Decoder, fastest
from distrace.fitting.judge import Verdict, judged
from distrace.fitting.placement_network import PlacementNetwork, guess_placement
from distrace.fitting.proposals import axes_around, proposed
from distrace.fitting.rounds import Ends, Progress, Round, run_rounds
from distrace.fitting.scan_residuals import Belief, PlacedCode, ScanProblem, ScanSample
from distrace.fitting.solver import SolverConfig, charbonnier
from distrace.pose import Similarity
from distrace.prior import Prior

SOLVER = SolverConfig(damping=1e-2, settled=1e-3)
SCREENING = Round(0, 0, 32, 60, 60, 4, 0.06, charbonnier)  # where there are more starts than the first round takes
DEVIATION_FACTOR = 1.5  # × the network's deviations: the points that it has seen count again
LEAST_DEVIATION = 0.02
EQUAL = 0.15  # of the least loss: an end that is no worse by more may be right as well


@dataclass(frozen=True)
class ScanFitConfig:
    """The rounds of a fit, coarse to fine."""

    rounds: tuple[Round, ...] = (
        Round(6, 6, 32, 100, 80, 6, 0.06, charbonnier),
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

    The model's `network`, where it has one, says where to start; otherwise typical shapes are tried at many places.
    """
    began = time.perf_counter()
    quick = fastest(decoder)
    random = torch.Generator().manual_seed(config.seed)
    states, beliefs = _starts(scan, quick, prior, config, place, start, network)
    rounds = config.rounds
    if len(states) > rounds[0].starts:
        rounds = (replace(SCREENING, starts=len(states)), *rounds)

    def problem_of(stage: Round) -> ScanProblem:
        sample = ScanSample.drawn(scan, stage.points, stage.rays, random)
        deviation = (stage.deviation**2 * scan.radius**2 + scan.noise**2) ** 0.5
        return ScanProblem(
            quick, prior, sample, deviation, beliefs, scan.tilt, stage.samples, place is None, margin=stage.margin
        )

    ends = run_rounds(states, rounds, problem_of, SOLVER, progress)
    return _fitted(decoder, scan, prior, ends, began)


def _starts(
    scan: Scan,
    decoder: Decoder | BFloat16Decoder,
    prior: Prior,
    config: ScanFitConfig,
    place: Similarity | None,
    start: PlacedCode | None,
    network: PlacementNetwork | None,
) -> tuple[list[PlacedCode], list[Belief]]:
    """Returns where to start, and where each start is likely to end."""
    if start is not None:
        return [start], [_belief(start.place, scan)]
    if place is not None:
        return [PlacedCode(0, prior.mean, prior.mean[:0], place)], [_belief(place, scan)]
    if network is None:
        states = proposed(scan, decoder, prior, config.rounds[0].starts, config.seed)
        return states, [_belief(state.place, scan) for state in states]
    states = []
    beliefs = []
    ups = scan.ups if len(scan.ups) else axes_around()
    for up in ups:
        guess = guess_placement(network, scan.to("cpu"), up.cpu(), config.seed)
        for likely in guess.places(config.rounds[0].starts):
            likely = likely.to(prior.mean.device)
            belief = _belief(likely, scan)
            states.append(PlacedCode(len(states), prior.mean, prior.mean[:0], likely))
            beliefs.append(
                replace(
                    belief,
                    size_deviation=max(DEVIATION_FACTOR * guess.size_deviation, LEAST_DEVIATION),
                    centre_deviation=max(DEVIATION_FACTOR * guess.centre_deviation, LEAST_DEVIATION),
                )
            )
    return states, beliefs


def _fitted(decoder: Decoder, scan: Scan, prior: Prior, ends: Ends, began: float) -> ScanFit:
    least, best = ends.losses[0], ends.states[0]
    codes = [state.code(prior) for state in ends.states]
    sdf = decoder.field(codes[0])
    equal = [k for k, loss in enumerate(ends.losses) if k and loss <= (1 + EQUAL) * least]
    others = tuple((codes[k], ends.states[k].place) for k in equal)
    verdict = judged(scan, sdf, best.place, [(decoder.field(code), place) for code, place in others])
    seconds = time.perf_counter() - began
    return ScanFit(codes[0], best.place, least, verdict, ends.curves, ends.evaluations, seconds, others)


def _belief(place: Similarity, scan: Scan) -> Belief:
    """Returns what is likely of an end whose start is only a proposal."""
    axis = place.rotation[:, 1]
    up = scan.ups[(scan.ups @ axis).argmax()] if len(scan.ups) else None
    return Belief(float(place.scale), place.translation, up)
