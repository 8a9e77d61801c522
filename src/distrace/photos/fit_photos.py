"""Fits a shape's code and placement to photographs with known cameras: no depth, and masks only where given.

Multi-start Levenberg–Marquardt, from coarse images to fine ones. As in DIST (Liu et al., CVPR 2020, section 4.3) the
shape and a similarity are fitted together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.decoder import Decoder
from distrace.fitting.solver import SolverConfig, charbonnier, minimise
from distrace.photos.initialisation import Initialiser
from distrace.photos.judge import inconsistencies
from distrace.photos.photo_set import PhotoSet
from distrace.photos.problem import ComparisonConfig, PlacedShape
from distrace.pose import Similarity
from distrace.prior import Prior

PLACEMENT = -1  # `start` of the steps that find the placement


@dataclass(frozen=True)
class PhotoConfig:
    """The schedule, in rounds of a few iterations on the same rays; each round draws new ones."""

    rounds: int = 18
    coarse_rounds: int = 4  # the first of each start, with images of half the size; a trial ends with fine ones
    iterations: int = 4  # of each round
    starts: int = 4
    trial_rounds: int = 6  # of each start, before the best one goes on
    place_rounds: int = 6  # of the mean shape, before all starts, where the placement is unknown
    comparison: ComparisonConfig = ComparisonConfig()
    outline_scale: float = 0.06  # of outline residuals, in radii, in the first round …
    outline_decay: float = 0.6  # … × this from one round to the next, …
    outline_least: float = 0.005  # … and no less than this
    damping: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        least = min(self.rounds, self.iterations, self.starts, self.trial_rounds, self.place_rounds)
        if least < 1:
            raise ValueError(f"{self} was given; rounds, iterations and starts must each be at least 1")

    @property
    def tried(self) -> int:
        """Rounds of each start before the choice; the best has at least one left."""
        return min(self.trial_rounds, self.rounds - 1) if self.starts > 1 else 0

    @property
    def total(self) -> int:
        """Iterations of all starts, and of the placement."""
        placement = min(self.place_rounds, self.rounds) if self.comparison.fit_place else 0
        return self.iterations * (placement + self.tried * (self.starts - 1) + self.rounds)


UNKNOWN_PLACE = PhotoConfig()
KNOWN_PLACE = PhotoConfig(rounds=12, comparison=ComparisonConfig(fit_place=False))
"""For a shape that lies as the model's do: its code alone takes fewer rounds."""


@dataclass(frozen=True)
class PhotoStep:
    """The code and the placement after an iteration."""

    start: int
    iteration: int
    loss: float
    terms: dict[str, float]
    code: Float[Tensor, "length"]
    place: Similarity

    @property
    def name(self) -> str:
        """What it is a step of."""
        return "placement" if self.start == PLACEMENT else f"start {self.start + 1}"


@dataclass
class PhotoFit:
    """All steps of a fit, of which the last is the result, and the evaluations of the field that they took."""

    steps: list[PhotoStep] = field(default_factory=list)
    evaluations: int = 0
    setup_evaluations: int = 0  # of these, those of the initialisation

    @property
    def last(self) -> PhotoStep:
        """The result."""
        return self.steps[-1]


def fit_photos(
    decoder: Decoder,
    photographs: Sequence[Photograph],
    prior: Prior,
    config: PhotoConfig = UNKNOWN_PLACE,
    place: Similarity | None = None,
    callback: Callable[[PhotoStep], None] = lambda step: None,
) -> PhotoFit:
    """Fits a shape to photographs whose cameras see the unit sphere, on the prior's device.

    An unknown placement is fitted first, with the mean shape, from `place` (by default the identity) or from
    `Initialiser.locate`, whichever contradicts the photographs less: in a wrong place wrong training shapes fit best.
    Then all starts begin there: the mean shape, the training shapes of the least loss, and a draw from the prior. The
    start with the least inconsistency goes on, and its last step is the result. `callback` receives every step.

    Raises `ValueError` for fewer than two photographs.
    """
    if len(photographs) < 2:
        raise ValueError(f"{len(photographs)} photographs were given; colours are compared between two at least")
    device = prior.mean.device
    views = [photograph.to(device) for photograph in photographs]
    fine = PhotoSet(decoder, views, prior, config.comparison)
    coarse = PhotoSet(decoder, [view.resized(0.5) for view in views], prior, config.comparison)
    levels = [coarse if number < config.coarse_rounds else fine for number in range(config.rounds)]
    initialiser = Initialiser(levels[0], config.seed)
    place = (place or Similarity.identity()).to(device)
    fit = PhotoFit()

    if config.comparison.fit_place:
        place = initialiser.likelier([place, initialiser.locate(fine, place)])
        mean_shape = _PhotoDescent(PLACEMENT, PlacedShape(initialiser.mean_shape, place), config)
        mean_shape.run(levels, config.place_rounds, fit, callback)
        place = mean_shape.shape.place

    starts = initialiser.starts(place, config.starts)
    descents = [_PhotoDescent(start, PlacedShape(w, place), config) for start, w in enumerate(starts)]
    best = 0
    if config.tried:
        for descent in descents:
            descent.run(levels, config.tried, fit, callback)
        verdicts, evaluations = inconsistencies(fine, [descent.shape for descent in descents], config.seed)
        fit.evaluations += evaluations
        best = min(range(len(verdicts)), key=lambda start: verdicts[start])
    descents[best].run(levels, config.rounds, fit, callback)
    fit.setup_evaluations = initialiser.evaluations
    fit.evaluations += initialiser.evaluations
    return fit


class _PhotoDescent:
    """One start on its way down, which can be interrupted between rounds."""

    def __init__(self, start: int, shape: PlacedShape, config: PhotoConfig) -> None:
        self.start = start
        self.shape = shape
        self.config = config
        self.expected_place = shape.place
        self.damping = config.damping
        self.random = torch.Generator().manual_seed(config.seed)
        self.rounds = 0

    def run(
        self, levels: Sequence[PhotoSet], rounds: int, fit: PhotoFit, callback: Callable[[PhotoStep], None]
    ) -> None:
        """Goes on until so many rounds of it are done, as far as there are levels, one for each round."""
        config = self.config
        for number in range(self.rounds, min(rounds, len(levels))):
            photos = levels[number]
            sample = photos.sample(self.shape, config.comparison.rays, self.random)
            problem, state = photos.problem(sample)
            problem.expected_place = self.expected_place
            problem.outline_scale = max(config.outline_scale * config.outline_decay**number, config.outline_least)
            solver = SolverConfig(config.iterations, self.damping, even=True, kernel=charbonnier, settled=0.0)
            for solution in minimise(problem.residuals, state, problem.retract, solver):
                self.shape = solution.state.shape
                self.damping = solution.damping
                terms = problem.terms(solution.state, solution.residuals)
                iteration = number * config.iterations + solution.iteration
                code = photos.prior.code(self.shape.w)
                step = PhotoStep(self.start, iteration, sum(terms.values()), terms, code, self.shape.place)
                fit.steps.append(step)
                callback(step)
            fit.evaluations += problem.evaluations
            self.rounds = number + 1
