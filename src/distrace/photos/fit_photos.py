"""Fitting a shape's code, and where the shape lies, to photographs: no depth, no masks, known cameras.

From coarse images to fine ones, by Levenberg–Marquardt. As in DIST (Liu et al., CVPR 2020, section 4.3) the shape and a
similarity are found together, from several starts.
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
from distrace.photos.initialisation import Search
from distrace.photos.model_selection import contradictions
from distrace.photos.residuals import Shape
from distrace.photos.stage import Comparing, Stage
from distrace.pose import Similarity
from distrace.prior import Prior

APPROACH = -1  # its steps' start


@dataclass(frozen=True)
class PhotoConfig(Starts):
    """Stages of a pyramid; each start is tried up to the finest: coarse images do not tell which will agree with it."""

    iterations: int = 72
    starts: int = 4
    trial: int = 24
    approach: int = 24  # iterations of the mean shape before all starts, to find the place where it is unknown
    levels: tuple[float, ...] = (*4 * (0.5,), *14 * (1.0,))  # of the images' size, a stage each: new rays
    compared: Comparing = Comparing()
    scale: float = 0.06  # up to which misplaced outlines count by their squares in the first stage …
    narrowing: float = 0.6  # … and × this from one to the next, …
    narrowest: float = 0.005  # … but no narrower
    damping: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.approach < 1:
            raise ValueError(f"{self.approach} iterations were given to approach in; at least 1 is needed")
        if not self.levels or not all(0 < level <= 1 for level in self.levels):
            raise ValueError(f"levels {self.levels} were given; each is a part of the images' size, up to 1")

    @property
    def total(self) -> int:
        return super().total + (min(self.approach, self.iterations) if self.compared.moves else 0)


UNKNOWN_PLACE = PhotoConfig()
KNOWN_PLACE = PhotoConfig(iterations=48, levels=(*4 * (0.5,), *8 * (1.0,)), compared=Comparing(moves=False))
"""For a shape that lies as the model's do: its code alone is found sooner."""


@dataclass(frozen=True)
class PhotoStep(Step):
    """The code and the place after an iteration."""

    place: Similarity = field(default_factory=Similarity.identity)
    searched: int = 0  # of the evaluations, those of the search for places and starts

    @property
    def name(self) -> str:
        return "approach" if self.start == APPROACH else super().name


def fit_photos(
    decoder: Decoder,
    photographs: Sequence[Photograph],
    prior: Prior,
    config: PhotoConfig = UNKNOWN_PLACE,
    place: Similarity | None = None,
) -> Iterator[PhotoStep]:
    """Fits a shape to photographs whose cameras see the unit sphere. The last step is the result.

    Where the place is unknown it is found first, with the mean shape, from that given or, if typical shapes contradict
    the photographs less there, from where they tell. There all starts begin: the mean shape again, the training shapes
    of the least loss, and one draw from the prior. The one that is off least by what all of them together take for the
    object goes on. On the prior's device, wherever the photographs are. Raises `ValueError` for fewer than two of them.
    """
    if len(photographs) < 2:
        raise ValueError(f"{len(photographs)} photographs were given; colours are compared between two at least")
    device, place = prior.mean.device, place or Similarity.identity()
    stages = _pyramid([each.to(device) for each in photographs], config)
    return _Fit(decoder, prior, config, stages).steps(place.to(device))


def _pyramid(photographs: Sequence[Photograph], config: PhotoConfig) -> list[Stage]:
    """A stage for each level; those of one level are the same."""
    kinds = {level: Stage.of(photographs, level, config.compared) for level in sorted(set(config.levels))}
    return [kinds[level] for level in config.levels]


@dataclass(frozen=True)
class _Fit:
    """What all starts share."""

    decoder: Decoder
    prior: Prior
    config: PhotoConfig
    stages: Sequence[Stage]

    def steps(self, place: Similarity) -> Iterator[PhotoStep]:
        config = self.config
        if config.compared.moves:
            for step in self._approached(place):
                yield step
                place = step.place
        began, search = time.perf_counter(), Search(self.decoder, self.prior, config.seed)
        starts = [Shape(w, place) for w in search.starts(self.stages[0], config.compared, place, config.starts)]
        steps = best_of(config, lambda start: self._solved(start, starts[start]), self._compared)
        yield from _charged(steps, search, time.perf_counter() - began)

    def _approached(self, place: Similarity) -> Iterator[PhotoStep]:
        """The mean shape's, which end where it lies: in a wrong place wrong training shapes fit best."""
        began, config = time.perf_counter(), self.config
        search = Search(self.decoder, self.prior, config.seed)
        place = search.likelier(self.stages[0], config.compared, (place, search.told(self.stages[-1], place)))
        searched, mean = time.perf_counter() - began, Shape(self.prior.start(0, config.seed), place)
        yield from _charged(islice(self._solved(APPROACH, mean), config.approach), search, searched)

    def _solved(self, start: int, shape: Shape) -> Iterator[PhotoStep]:
        config, prior = self.config, self.prior
        began, done, damping, expected = time.perf_counter(), 0, config.damping, shape.place
        random = torch.Generator().manual_seed(config.seed)
        for number, length in stages_of(config.iterations, len(self.stages)):
            stage = self.stages[number]
            glimpse = stage.glimpse(self.decoder, prior, shape, config.compared.rays, random)
            problem, look = stage.problem(glimpse, config.compared)
            problem.expected = expected
            problem.scale, evaluations = max(config.scale * config.narrowing**number, config.narrowest), 0
            solver = SolverConfig(length, damping, even=True, kernel=charbonnier, settled=0.0)
            for found in minimise(problem.residuals, look, problem.moved, solver):
                shape, damping, done = found.state.shape, found.damping, done + 1
                terms = problem.terms(found.state, found.residuals)
                seconds, before, evaluations = time.perf_counter() - began, evaluations, problem.evaluations
                loss, code = sum(terms.values()), prior.code(shape.w)
                yield PhotoStep(start, done, loss, terms, code, seconds, evaluations - before, place=shape.place)
                began = time.perf_counter()

    def _compared(self, trials: Sequence[Sequence[PhotoStep]]) -> list[PhotoStep]:
        """Their ends, judged by what all of them together take for the object."""
        began, ends = time.perf_counter(), [trial[-1] for trial in trials]
        shapes = [Shape(self.prior.coordinates(end.code), end.place) for end in ends]
        compared, seed = self.config.compared, self.config.seed
        found = contradictions(self.stages[-1], self.decoder, self.prior, shapes, compared, seed)
        seconds = (time.perf_counter() - began) / len(ends)
        return [
            replace(end, verdict=off, seconds=seconds, evaluations=evaluations)
            for end, (off, evaluations) in zip(ends, found, strict=True)
        ]


def _charged(steps: Iterator[PhotoStep], search: Search, seconds: float) -> Iterator[PhotoStep]:
    """The first of them with what the search before has taken."""
    step = next(steps)
    evaluations = step.evaluations + search.evaluations
    yield replace(step, seconds=step.seconds + seconds, evaluations=evaluations, searched=search.evaluations)
    yield from steps
