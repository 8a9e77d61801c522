"""Fits a shape's code where its placement is known, by multi-start Levenberg–Marquardt: to views, or to points."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.observation import View
from distrace.fields.decoder import Decoder
from distrace.fields.precision import fastest
from distrace.fitting.observed import Observed
from distrace.fitting.rounds import Ends, Progress, Round, run_rounds
from distrace.fitting.scan_residuals import EFFECTIVE_POINTS, MARGIN, PlacedCode, ScanProblem
from distrace.fitting.solver import SolverConfig, charbonnier
from distrace.fitting.starts import Hints, nearest_codes
from distrace.pose import Similarity
from distrace.prior import START_DEVIATION, Prior

HINTS = (100, 300)  # points and rays that tell which training shapes are near
SAMPLES = 8  # on each ray in the unit sphere, about a quarter of a radius apart; the least one is refined
SOLVER = SolverConfig(damping=0.1, even=True, settled=0.0)
MEAN_DEVIATION = 1.1  # of a code's coordinates in the last round, from the mean; more where the shape is rough
POINTS_ALONE = 2000.0  # what all points count together where no silhouette is known
SILHOUETTE_RAYS = 4000.0  # what all rays of an exact silhouette count together; less where there are few
LAST_MARGIN = 0.25  # deviations that a free ray keeps from the surface in the last round
ROUGH = 3.0  # × the deviation, in the first round


@dataclass(frozen=True)
class CodeFitConfig:
    """Two rounds: all starts roughly, and the best ones to the end. All draws follow from the seed."""

    starts: int = 8  # the mean shape, and the training shapes that are nearest
    finalists: int = 3
    iterations: int = 16  # of the best start, of which three eighths are in the first round
    points: int = 500  # of each view, in the second round; a fifth in the first one
    rays: int = 800  # the same; a third in the first round
    deviation: float = 0.02  # of a shape that the model represents from the observation, in radii of the unit sphere
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.iterations, self.starts, self.finalists) < 1:
            given = f"{self.iterations} iterations and {self.starts} starts, {self.finalists} of them to the end,"
            raise ValueError(f"{given} were given; each must be at least 1")

    @property
    def rounds(self) -> tuple[Round, ...]:
        """The rounds, the last of which is never empty."""
        first = self.iterations * 3 // 8
        every = 1 << 20  # dimensions: all that the prior has
        fine = Round(
            self.finalists,
            self.iterations - first,
            every,
            self.points,
            self.rays,
            SAMPLES,
            self.deviation,
            charbonnier,
            LAST_MARGIN,
        )
        rough = replace(
            fine,
            starts=self.starts,
            iterations=first,
            points=self.points // 5,
            rays=self.rays // 3,
            deviation=ROUGH * self.deviation,
            margin=MARGIN,
        )
        return (rough, fine) if first else (fine,)

    @property
    def total(self) -> int:
        """Iterations of all rounds."""
        return self.iterations


@dataclass(frozen=True)
class CodeFit:
    """The code that explains an observation best."""

    code: Float[Tensor, "length"]
    loss: float
    losses: dict[str, list[float]]  # over the iterations of each start that reached the last round, the best one first
    evaluations: int  # of the field
    seconds: float

    def _repr_html_(self) -> str:
        """Returns what Jupyter shows."""
        from distrace import notebook

        facts = {"loss": self.loss, "evaluations": self.evaluations, "seconds": self.seconds}
        return notebook.table("CodeFit", facts)


def fit_code(
    decoder: Decoder,
    views: Sequence[View],
    prior: Prior,
    config: CodeFitConfig = CodeFitConfig(),
    progress: Progress | None = None,
) -> CodeFit:
    """Fits a code to views of the shape in the unit sphere, from the mean shape and the nearest training shapes.

    Raises `ValueError` without views, or with one from inside the mean shape.

    >>> model = dt.load_model("sofas")  # doctest: +SKIP
    >>> fit = dt.fit_code(model.decoder, [dt.load_view(path)], dt.prior_of(model.codes))  # doctest: +SKIP
    """
    return fit_observed(decoder, Observed.of_views(decoder, views, prior), prior, config, progress)


def fit_points(
    decoder: Decoder,
    samples: Float[Tensor, "n 4"],
    prior: Prior,
    config: CodeFitConfig = CodeFitConfig(),
    progress: Progress | None = None,
) -> CodeFit:
    """Fits a code to points and their signed distances from the surface, which are 0 on it, as `fit_code` to views.

    A distance beyond 0.1 only tells on which side a point lies. Raises `ValueError` without points.
    """
    return fit_observed(decoder, Observed.of_points(samples), prior, config, progress)


def fit_observed(
    decoder: Decoder, observed: Observed, prior: Prior, config: CodeFitConfig, progress: Progress | None = None
) -> CodeFit:
    """Fits a code from the mean shape and the training shapes that contradict the observation least."""
    began = time.perf_counter()
    random = torch.Generator().manual_seed(config.seed)
    quick = fastest(decoder)
    hints = Hints.of(observed.draw(*HINTS, random), random)
    nearest, evaluations = nearest_codes(quick, prior.codes, hints, config.starts - 1)
    w = [torch.zeros_like(prior.mean), *(prior.coordinates(code) for code in nearest)]
    states = [PlacedCode(k, prior.mean, each, _identity(prior)) for k, each in enumerate(w)]
    ends = minimised(decoder, observed, prior, states, config, progress)
    seconds = time.perf_counter() - began
    return CodeFit(ends.states[0].code(prior), ends.losses[0], ends.curves, evaluations + ends.evaluations, seconds)


def plausible_codes(
    decoder: Decoder, observed: Observed, prior: Prior, count: int, config: CodeFitConfig
) -> tuple[list[Float[Tensor, "length"]], int]:
    """Returns codes that all fit, best first, and the number of evaluations.

    Each is drawn to another draw of the prior than its mean, and follows it where nothing was observed (randomise, then
    optimise: Bardsley et al., SIAM J. Sci. Comput. 2014).
    """
    random = torch.Generator().manual_seed(config.seed)
    bases = [prior.code(prior.draw(random, START_DEVIATION)) for _ in range(2 * count)]  # half may end far off
    states = [PlacedCode(k, base, torch.zeros_like(base), _identity(prior)) for k, base in enumerate(bases)]
    ends = minimised(decoder, observed, prior, states, replace(config, starts=len(states), finalists=count), None)
    return [state.code(prior) for state in ends.states], ends.evaluations


def minimised(
    decoder: Decoder,
    observed: Observed,
    prior: Prior,
    states: Sequence[PlacedCode],
    config: CodeFitConfig,
    progress: Progress | None,
) -> Ends:
    """Runs the rounds from given states."""
    quick = fastest(decoder)
    random = torch.Generator().manual_seed(config.seed + 1)

    def problem_of(stage: Round) -> ScanProblem:
        sample = observed.draw(stage.points, stage.rays, random)
        deviation = (stage.deviation**2 + observed.noise**2) ** 0.5
        has_silhouette = len(sample.until) > len(sample.points)  # rays beside those of the depths
        return ScanProblem(
            quick,
            prior,
            sample,
            deviation,
            placement_priors=(),
            tilt=0.0,
            samples=stage.samples,
            moves=False,
            code_deviation=MEAN_DEVIATION * (stage.deviation / config.deviation) ** 0.5,
            effective_points=EFFECTIVE_POINTS if has_silhouette else POINTS_ALONE,
            effective_rays=SILHOUETTE_RAYS * min(1.0, len(sample.until) / max(stage.rays, 1)),
            margin=stage.margin,
        )

    return run_rounds(states, config.rounds, problem_of, SOLVER, progress)


def _identity(prior: Prior) -> Similarity:
    return Similarity.identity().to(prior.mean.device)
