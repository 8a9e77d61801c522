"""Fits a shape's code and placement to photographs with known cameras: no depth, and masks only where given.

Levenberg–Marquardt from coarse images to fine ones. As in DIST (Liu et al., CVPR 2020, section 4.3) the shape and a
similarity are fitted together, from several starts.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import torch

from distrace.data.photograph import Photograph
from distrace.fields.decoder import Decoder
from distrace.fitting.multistart import Starts, Step, best_of, stages_of
from distrace.fitting.solver import SolverConfig, charbonnier, minimise
from distrace.photos.initialisation import Initialiser
from distrace.photos.pyramid import PyramidLevel
from distrace.photos.residuals import ComparisonConfig, PlacedShape
from distrace.photos.selection import inconsistencies
from distrace.pose import Similarity
from distrace.prior import Prior

PLACEMENT = -1  # `start` of the steps that find the placement


@dataclass(frozen=True)
class PhotoConfig(Starts):
    """The schedule. Each start is tried up to the finest level: coarse images do not tell which start is best."""

    iterations: int = 72
    starts: int = 4
    trial: int = 24
    place_iterations: int = 24  # of the mean shape, before all starts, where the placement is unknown
    levels: tuple[float, ...] = (*4 * (0.5,), *14 * (1.0,))  # factors of the images' size, each with new rays
    comparison: ComparisonConfig = ComparisonConfig()
    outline_scale: float = 0.06  # of outline residuals, in radii, at the first level …
    outline_decay: float = 0.6  # … × this from one level to the next, …
    outline_least: float = 0.005  # … and no less than this
    damping: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.place_iterations < 1:
            raise ValueError(f"{self.place_iterations} iterations were given for the placement; at least 1 is needed")
        if not self.levels or not all(0 < level <= 1 for level in self.levels):
            raise ValueError(f"levels {self.levels} were given; each is a part of the images' size, up to 1")

    @property
    def total(self) -> int:
        """Iterations of all starts, and of the placement."""
        return super().total + (min(self.place_iterations, self.iterations) if self.comparison.fit_place else 0)


UNKNOWN_PLACE = PhotoConfig()
KNOWN_PLACE = PhotoConfig(
    iterations=48, levels=(*4 * (0.5,), *8 * (1.0,)), comparison=ComparisonConfig(fit_place=False)
)
"""For a shape that lies as the model's do: its code alone takes fewer iterations."""


@dataclass(frozen=True)
class PhotoStep(Step):
    """The code and the placement after an iteration."""

    place: Similarity = field(default_factory=Similarity.identity)
    searched: int = 0  # of the evaluations, those of the initialisation

    @property
    def name(self) -> str:
        return "placement" if self.start == PLACEMENT else super().name


def fit_photos(
    decoder: Decoder,
    photographs: Sequence[Photograph],
    prior: Prior,
    config: PhotoConfig = UNKNOWN_PLACE,
    place: Similarity | None = None,
) -> Iterator[PhotoStep]:
    """Fits a shape to photographs whose cameras see the unit sphere, on the prior's device; yields every step.

    An unknown placement is fitted first, with the mean shape, from `place` (by default the identity) or from
    `Initialiser.locate`, whichever contradicts the photographs less. Then all starts begin there: the mean shape, the
    training shapes of the least loss, and a draw from the prior. The start with the least inconsistency goes on,
    and its last step is the result. Raises `ValueError` for fewer than two photographs.
    """
    if len(photographs) < 2:
        raise ValueError(f"{len(photographs)} photographs were given; colours are compared between two at least")
    device = prior.mean.device
    moved = [photograph.to(device) for photograph in photographs]
    levels = {factor: PyramidLevel.of(moved, factor, config.comparison) for factor in sorted(set(config.levels))}
    fit = _Fit(decoder, prior, config, [levels[factor] for factor in config.levels])
    return fit.steps((place or Similarity.identity()).to(device))


@dataclass(frozen=True)
class _Fit:
    """What all starts share."""

    decoder: Decoder
    prior: Prior
    config: PhotoConfig
    levels: Sequence[PyramidLevel]

    def steps(self, place: Similarity) -> Iterator[PhotoStep]:
        """The steps of the placement, where it is unknown, and of all starts."""
        config = self.config
        if config.comparison.fit_place:
            for step in self._fit_place(place):
                yield step
                place = step.place
        began = time.perf_counter()
        initialiser = Initialiser(self.decoder, self.prior, config.seed)
        starts = initialiser.starts(self.levels[0], config.comparison, place, config.starts)
        steps = best_of(config, lambda start: self._fit(start, PlacedShape(starts[start], place)), self._judged)
        yield from _charged(steps, initialiser, time.perf_counter() - began)

    def _fit_place(self, place: Similarity) -> Iterator[PhotoStep]:
        """Fits the mean shape: in a wrong place wrong training shapes fit best."""
        began = time.perf_counter()
        config = self.config
        initialiser = Initialiser(self.decoder, self.prior, config.seed)
        places = (place, initialiser.locate(self.levels[-1], place))
        place = initialiser.likelier(self.levels[0], config.comparison, places)
        seconds = time.perf_counter() - began
        steps = self._fit(PLACEMENT, PlacedShape(self.prior.start(0, config.seed), place))
        yield from _charged(islice(steps, config.place_iterations), initialiser, seconds)

    def _fit(self, start: int, shape: PlacedShape) -> Iterator[PhotoStep]:
        """The steps of one start, level by level."""
        config = self.config
        prior = self.prior
        expected_place = shape.place
        damping = config.damping
        random = torch.Generator().manual_seed(config.seed)
        iteration = 0
        began = time.perf_counter()
        for number, iterations in stages_of(config.iterations, len(self.levels)):
            level = self.levels[number]
            sample = level.sample(self.decoder, prior, shape, config.comparison.rays, random)
            problem, state = level.problem(sample, config.comparison)
            problem.expected_place = expected_place
            problem.outline_scale = max(config.outline_scale * config.outline_decay**number, config.outline_least)
            solver = SolverConfig(iterations, damping, even=True, kernel=charbonnier, settled=0.0)
            counted = 0
            for solution in minimise(problem.residuals, state, problem.retract, solver):
                shape = solution.state.shape
                damping = solution.damping
                iteration += 1
                terms = problem.terms(solution.state, solution.residuals)
                loss = sum(terms.values())
                seconds = time.perf_counter() - began
                evaluations = problem.evaluations - counted
                code = prior.code(shape.w)
                yield PhotoStep(start, iteration, loss, terms, code, seconds, evaluations, place=shape.place)
                began = time.perf_counter()
                counted = problem.evaluations

    def _judged(self, trials: Sequence[Sequence[PhotoStep]]) -> list[PhotoStep]:
        """The trials' last steps with their inconsistencies as verdicts."""
        began = time.perf_counter()
        last = [trial[-1] for trial in trials]
        shapes = [PlacedShape(self.prior.coordinates(step.code), step.place) for step in last]
        comparison = self.config.comparison
        found = inconsistencies(self.levels[-1], self.decoder, self.prior, shapes, comparison, self.config.seed)
        seconds = (time.perf_counter() - began) / len(last)
        return [
            replace(step, verdict=verdict, seconds=seconds, evaluations=evaluations)
            for step, (verdict, evaluations) in zip(last, found, strict=True)
        ]


def _charged(steps: Iterator[PhotoStep], initialiser: Initialiser, seconds: float) -> Iterator[PhotoStep]:
    """The steps, of which the first is charged with the initialisation's time and evaluations."""
    step = next(steps)
    evaluations = step.evaluations + initialiser.evaluations
    yield replace(step, seconds=step.seconds + seconds, evaluations=evaluations, searched=initialiser.evaluations)
    yield from steps
