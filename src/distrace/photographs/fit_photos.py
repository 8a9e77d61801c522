"""Fitting a shape's code, and where the shape lies, to photographs: no depth, no masks, known cameras.

From coarse images to fine ones, by Levenberg–Marquardt. As in DIST (Liu et al., CVPR 2020, section 4.3) the shape and a
similarity are found together, from several starts.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice

import torch

from distrace.data.photograph import Photograph
from distrace.decoder import Decoder
from distrace.fitting.prior import Prior
from distrace.fitting.solver import SolverConfig, charbonnier, minimise
from distrace.fitting.starts import Starts, Step, best_of, stages_of
from distrace.photographs.choice import contradictions
from distrace.photographs.residuals import Shape
from distrace.photographs.search import Search
from distrace.photographs.stage import Comparing, Stage
from distrace.pose import Similarity

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
        """Of what it is a step."""
        return "approach" if self.start == APPROACH else f"start {self.start + 1}"


def fit_photos(
    decoder: Decoder,
    photographs: Sequence[Photograph],
    prior: Prior,
    config: PhotoConfig = PhotoConfig(),
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
    return _fitted(decoder, [each.to(device) for each in photographs], prior, config, place.to(device))


def _fitted(
    decoder: Decoder, photographs: Sequence[Photograph], prior: Prior, config: PhotoConfig, there: Similarity
) -> Iterator[PhotoStep]:
    stages = _pyramid(photographs, config)
    if config.compared.moves:
        for step in _approached(decoder, stages, prior, config, there):
            yield step
            there = step.place
    began, search = time.perf_counter(), Search(decoder, prior, config.seed)
    starts = [Shape(w, there) for w in search.starts(stages[0], config.compared, there, config.starts)]
    compare = partial(_compared, decoder, stages[-1], prior, config)
    steps = best_of(config, lambda start: _solved(decoder, stages, prior, config, start, starts[start]), compare)
    yield from _charged(steps, search, time.perf_counter() - began)


def _approached(
    decoder: Decoder, stages: Sequence[Stage], prior: Prior, config: PhotoConfig, there: Similarity
) -> Iterator[PhotoStep]:
    """The mean shape's, which end where it lies: in a wrong place wrong training shapes fit best."""
    began, search = time.perf_counter(), Search(decoder, prior, config.seed)
    there = search.likelier(stages[0], config.compared, (there, search.told(stages[-1], there)))
    shape, searched = Shape(prior.start(0, config.seed), there), time.perf_counter() - began
    steps = _solved(decoder, stages, prior, config, APPROACH, shape)
    yield from _charged(islice(steps, config.approach), search, searched)


def _charged(steps: Iterator[PhotoStep], search: Search, seconds: float) -> Iterator[PhotoStep]:
    """The first of them with what the search before has taken."""
    step = next(steps)
    evaluations = step.evaluations + search.evaluations
    yield replace(step, seconds=step.seconds + seconds, evaluations=evaluations, searched=search.evaluations)
    yield from steps


def _pyramid(photographs: Sequence[Photograph], config: PhotoConfig) -> list[Stage]:
    """A stage for each level; those of one level are the same."""
    kinds = {level: Stage.of(photographs, level, config.compared) for level in sorted(set(config.levels))}
    return [kinds[level] for level in config.levels]


def _solved(
    decoder: Decoder, stages: Sequence[Stage], prior: Prior, config: PhotoConfig, start: int, shape: Shape
) -> Iterator[PhotoStep]:
    began, done, damping, expected = time.perf_counter(), 0, config.damping, shape.place
    random = torch.Generator().manual_seed(config.seed)
    for number, length in stages_of(config.iterations, len(stages)):
        stage = stages[number]
        glimpse = stage.glimpse(decoder, prior, shape, config.compared.rays, random)
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


def _compared(
    decoder: Decoder, stage: Stage, prior: Prior, config: PhotoConfig, trials: Sequence[Sequence[PhotoStep]]
) -> list[PhotoStep]:
    """Their ends, judged by what all of them together take for the object."""
    began, ends = time.perf_counter(), [trial[-1] for trial in trials]
    shapes = [Shape(prior.coordinates(end.code), end.place) for end in ends]
    found = contradictions(stage, decoder, prior, shapes, config.compared, config.seed)
    seconds = (time.perf_counter() - began) / len(ends)
    return [
        replace(end, verdict=off, seconds=seconds, evaluations=evaluations)
        for end, (off, evaluations) in zip(ends, found, strict=True)
    ]
