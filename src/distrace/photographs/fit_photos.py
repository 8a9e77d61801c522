"""Fitting a shape's code, and where the shape lies, to photographs: no depth, no masks, known cameras.

From coarse images to fine ones, by Levenberg–Marquardt. As in DIST (Liu et al., CVPR 2020, section 4.3) the shape and a
similarity are found together, from several starts.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median

import torch

from distrace.data.photograph import Photograph
from distrace.decoder import Decoder
from distrace.field import Counted
from distrace.fitting.prior import Prior
from distrace.fitting.solver import SolverConfig, charbonnier, minimise
from distrace.fitting.starts import Starts, Step, best_of, stages_of
from distrace.photographs.choice import contradictions
from distrace.photographs.residuals import Shape
from distrace.photographs.stage import Comparing, Stage
from distrace.photographs.whereabouts import whereabouts
from distrace.pose import Similarity

SCREENED = 400  # rays on which all training shapes are compared, …
COMPARED = 1000  # … and those on which the best of them are: one in so many, and no fewer than
KEPT, FEWEST = 8, 8
TYPICAL = 5  # training shapes, nearest to the mean, that say how large an object is
ASKED = 8  # of them, of which place is the likelier


@dataclass(frozen=True)
class PhotoConfig(Starts):
    """Stages of a pyramid; each start is tried up to the finest: coarse images do not tell which will agree with it."""

    iterations: int = 48
    starts: int = 4
    trial: int = 24
    levels: tuple[float, ...] = (*4 * (0.5,), *8 * (1.0,))  # of the images' size, a stage each: new rays
    compared: Comparing = Comparing()
    scale: float = 0.06  # up to which misplaced outlines count by their squares in the first stage …
    narrowing: float = 0.6  # … and × this from one to the next, …
    narrowest: float = 0.005  # … but no narrower
    damping: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.levels or not all(0 < level <= 1 for level in self.levels):
            raise ValueError(f"levels {self.levels} were given; each is a part of the images' size, up to 1")


@dataclass(frozen=True)
class PhotoStep(Step):
    """The code and the place after an iteration."""

    place: Similarity = field(default_factory=Similarity.identity)
    searched: int = 0  # of the evaluations, those of the search for starts: in the first step


def fit_photos(
    decoder: Decoder,
    photographs: Sequence[Photograph],
    prior: Prior,
    config: PhotoConfig = PhotoConfig(),
    place: Similarity | None = None,
) -> Iterator[PhotoStep]:
    """Fits a shape to photographs whose cameras see the unit sphere. The last step is the result.

    Starts are the mean shape, the training shapes of the least loss, and one draw from the prior, all in the same
    place: that given or, if it is unknown and they contradict it less there, where the photographs tell. The one
    that is off least by what all of them together take for the object goes on. On the prior's device, wherever the
    photographs are. Raises `ValueError` for fewer than two of them.
    """
    if len(photographs) < 2:
        raise ValueError(f"{len(photographs)} photographs were given; colours are compared between two at least")
    device, place = prior.mean.device, place or Similarity.identity()
    return _fitted(decoder, [each.to(device) for each in photographs], prior, config, place.to(device))


def _fitted(
    decoder: Decoder, photographs: Sequence[Photograph], prior: Prior, config: PhotoConfig, there: Similarity
) -> Iterator[PhotoStep]:
    """The first step is charged with the search for starts."""
    began, stages, search = time.perf_counter(), _pyramid(photographs, config), Search(decoder, prior, config.seed)
    if config.compared.moves:
        there = search.likelier(stages[0], config.compared, (there, search.told(stages[-1], there)))
    starts = [Shape(w, there) for w in search.starts(stages[0], config, there)]
    searched = time.perf_counter() - began
    compare = partial(_compared, decoder, stages[-1], prior, config)
    steps = best_of(config, lambda start: _solved(decoder, stages, prior, config, start, starts[start]), compare)
    step = next(steps)
    evaluations = step.evaluations + search.evaluations
    yield replace(step, seconds=step.seconds + searched, evaluations=evaluations, searched=search.evaluations)
    yield from steps


def _pyramid(photographs: Sequence[Photograph], config: PhotoConfig) -> list[Stage]:
    """A stage for each level; those of one level are the same."""
    kinds = {level: Stage.of(photographs, level, config.compared) for level in sorted(set(config.levels))}
    return [kinds[level] for level in config.levels]


@dataclass
class Search:
    """Where fits begin: which places and training shapes contradict photographs least; and the evaluations so far."""

    decoder: Decoder
    prior: Prior
    seed: int = 0
    evaluations: int = 0

    def told(self, stage: Stage, like: Similarity) -> Similarity:
        """Where the photographs let an object of the class be."""
        prior = self.prior
        typical = sorted((prior.coordinates(code) for code in prior.codes), key=torch.norm)[:TYPICAL]
        shapes = [Counted(self.decoder.field(prior.code(w))) for w in typical or [prior.start(0, self.seed)]]
        place = whereabouts(stage, shapes, like)
        self.evaluations += sum(shape.evaluations for shape in shapes)
        return place

    def likelier(self, stage: Stage, compared: Comparing, places: Sequence[Similarity]) -> Similarity:
        """The place where a few shapes contradict the photographs least."""
        few, prior = replace(compared, rays=SCREENED), self.prior
        some = prior.codes[:: max(1, -(-len(prior.codes) // ASKED))]
        shapes = [prior.start(0, self.seed), *(prior.coordinates(code) for code in some)]
        return min(places, key=lambda place: median(self._loss(stage, few, Shape(w, place)) for w in shapes))

    def ranked(self, stage: Stage, compared: Comparing, place: Similarity) -> list[tuple[float, torch.Tensor]]:
        """The losses and coordinates of the best training shapes, the least first; of all of them, on fewer rays."""
        codes = [self.prior.coordinates(code) for code in self.prior.codes]
        for rays in (min(SCREENED, compared.rays), compared.rays):
            losses = [self._loss(stage, replace(compared, rays=rays), Shape(w, place)) for w in codes]
            order = sorted(range(len(codes)), key=lambda number: losses[number])
            codes = [codes[number] for number in order[: max(len(self.prior.codes) // KEPT, FEWEST)]]
        return [(losses[number], w) for number, w in zip(order, codes)]

    def starts(self, stage: Stage, config: PhotoConfig, place: Similarity) -> list[torch.Tensor]:
        """The mean's coordinates, those of training shapes, and a draw."""
        few, wanted = replace(config.compared, rays=COMPARED), config.starts - 2
        nearest = [w for _, w in self.ranked(stage, few, place)[:wanted]] if wanted > 0 else []
        draws = [self.prior.start(k, self.seed) for k in range(1, config.starts - len(nearest))]
        return [self.prior.start(0, self.seed), *nearest, *draws]

    def _loss(self, stage: Stage, compared: Comparing, shape: Shape) -> float:
        """Of colours and outlines, on rays that are the same for all shapes; infinite where nothing is contradicted
        because most views do not show the shape, or no ray meets it."""
        random = torch.Generator().manual_seed(self.seed)
        problem, look = stage.problem(self.decoder, self.prior, shape, compared, random)
        terms = problem.terms(look, problem.residuals(look))
        self.evaluations += problem.evaluations
        middle = shape.place.translation
        showing = [view.camera.shows(*view.camera.project(middle)) for view in stage.photographs]
        seen = look.hit.any() and 2 * sum(map(bool, showing)) >= len(showing)
        return terms["colour"] + terms["outline"] if seen else math.inf


def _solved(
    decoder: Decoder, stages: Sequence[Stage], prior: Prior, config: PhotoConfig, start: int, shape: Shape
) -> Iterator[PhotoStep]:
    began, done, damping, expected = time.perf_counter(), 0, config.damping, shape.place
    random = torch.Generator().manual_seed(config.seed)
    for number, length in stages_of(config.iterations, len(stages)):
        stage = stages[number]
        problem, look = stage.problem(decoder, prior, shape, config.compared, random)
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
