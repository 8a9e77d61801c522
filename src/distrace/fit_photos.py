"""Fitting a shape's code, and where the shape lies, to photographs: no depth, no masks, known cameras.

From coarse images to fine ones, by Levenberg–Marquardt. As in DIST (Liu et al., CVPR 2020, section 4.3) the shape and a
similarity are found together, from several starts.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from statistics import median

import torch

from distrace.data.photograph import Photograph
from distrace.decoder import Decoder
from distrace.photo_residuals import Shape
from distrace.photo_stage import Comparing, Stage
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.solver import SolverConfig, charbonnier, minimise
from distrace.starts import Starts, Step, best_of
from distrace.whereabouts import whereabouts

SCREENED = 400  # rays on which all training shapes are compared, …
COMPARED = 1000  # … and those on which the best of them are: one in so many, and no fewer than
KEPT, FEWEST = 8, 8
TYPICAL = 5  # training shapes, nearest to the mean, that say how large an object is
ASKED = 8  # of them, of which place is the likelier


@dataclass(frozen=True)
class PhotoConfig(Starts):
    """Stages of a pyramid; each start is tried on the first ones."""

    iterations: int = 24
    starts: int = 4
    trial: int = 8
    levels: tuple[float, ...] = (0.25, 0.25, 0.5, 0.5, 1.0, 1.0)  # of the images' size, a stage each
    compared: Comparing = Comparing()
    scale: float = 0.06  # up to which misplaced outlines count by their squares in the first stage …
    narrowing: float = 0.6  # … and × this from one to the next
    damping: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.levels or not all(0 < level <= 1 for level in self.levels):
            raise ValueError(f"levels {self.levels} were given; each is a part of the images' size, up to 1")

    @property
    def stage_lengths(self) -> list[int]:
        count = len(self.levels)
        ends = [self.iterations * stage // count for stage in range(count + 1)]
        return [end - begin for begin, end in pairwise(ends)]


@dataclass(frozen=True)
class PhotoStep(Step):
    """The code and the place after an iteration."""

    place: Similarity = field(default_factory=Similarity.identity)


def fit_photos(
    decoder: Decoder,
    photographs: Sequence[Photograph],
    prior: Prior,
    config: PhotoConfig = PhotoConfig(),
    place: Similarity | None = None,
) -> Iterator[PhotoStep]:
    """Fits a shape to photographs whose cameras see the unit sphere. The last step is the result.

    Starts are the mean shape, the training shapes of the least loss, and one draw from the prior, all in the same
    place: that given or, if it is unknown and they contradict it less there, where the photographs tell; the one whose
    loss falls lowest goes on. On the CPU alone. Raises `ValueError` for fewer than two photographs, and for a decoder on
    another device.
    """
    if prior.mean.device.type != "cpu":
        raise ValueError(f"the decoder is on {prior.mean.device}; photographs are fitted on the CPU: move it there")
    if len(photographs) < 2:
        raise ValueError(f"{len(photographs)} photographs were given; colours are compared between two at least")
    stages = [Stage.of(photographs, level, config.compared) for level in config.levels]
    there = place or Similarity.identity()
    if config.compared.moves:
        typical = sorted((prior.coordinates(code) for code in prior.codes), key=torch.norm)[:TYPICAL]
        shapes = [decoder.field(prior.code(w)) for w in typical or [prior.start(0, config.seed)]]
        told = whereabouts(stages[-1], shapes, there)
        there = _likelier(decoder, stages[0], prior, config, (there, told))
    starts = [Shape(w, there) for w in _starts(decoder, stages[0], prior, config, there)]
    return best_of(config, lambda start: _solved(decoder, stages, prior, config, start, starts[start]), recent=1)


def _likelier(
    decoder: Decoder, stage: Stage, prior: Prior, config: PhotoConfig, places: Sequence[Similarity]
) -> Similarity:
    """The place where a few shapes contradict the photographs least."""
    few = replace(config.compared, rays=SCREENED)
    some = prior.codes[:: max(1, -(-len(prior.codes) // ASKED))]
    shapes = [prior.start(0, config.seed), *(prior.coordinates(code) for code in some)]

    def contradicted(place: Similarity) -> float:
        return median(_loss(decoder, stage, prior, few, Shape(w, place), config.seed) for w in shapes)

    return min(places, key=contradicted)


def ranked(
    decoder: Decoder, stage: Stage, prior: Prior, config: Comparing, place: Similarity, seed: int = 0
) -> list[tuple[float, torch.Tensor]]:
    """The losses and coordinates of the best training shapes, the least loss first; of all of them, on fewer rays."""
    codes = [prior.coordinates(code) for code in prior.codes]
    for rays in (min(SCREENED, config.rays), config.rays):
        losses = [_loss(decoder, stage, prior, replace(config, rays=rays), Shape(w, place), seed) for w in codes]
        order = sorted(range(len(codes)), key=lambda number: losses[number])
        codes = [codes[number] for number in order[: max(len(prior.codes) // KEPT, FEWEST)]]
    return [(losses[number], w) for number, w in zip(order, codes)]


def _loss(decoder: Decoder, stage: Stage, prior: Prior, config: Comparing, shape: Shape, seed: int) -> float:
    """Of colours and outlines, on rays that are the same for all shapes."""
    problem, look = stage.problem(decoder, prior, shape, config, torch.Generator().manual_seed(seed))
    terms = problem.terms(look, problem.residuals(look))
    return terms["colour"] + terms["outline"]


def _starts(decoder: Decoder, stage: Stage, prior: Prior, config: PhotoConfig, place: Similarity) -> list[torch.Tensor]:
    """The mean's coordinates, those of training shapes, and a draw."""
    if config.starts == 1:
        return [prior.start(0, config.seed)]
    few = replace(config.compared, rays=COMPARED)
    nearest = [w for _, w in ranked(decoder, stage, prior, few, place, config.seed)[: config.starts - 2]]
    draws = [prior.start(k, config.seed) for k in range(1, config.starts - len(nearest))]
    return [prior.start(0, config.seed), *nearest, *draws]


def _solved(
    decoder: Decoder, stages: Sequence[Stage], prior: Prior, config: PhotoConfig, start: int, shape: Shape
) -> Iterator[PhotoStep]:
    began, done, damping, expected = time.perf_counter(), 0, config.damping, shape.place
    random = torch.Generator().manual_seed(config.seed)
    for number, (stage, length) in enumerate(zip(stages, config.stage_lengths, strict=True)):
        problem, look = stage.problem(decoder, prior, shape, config.compared, random)
        problem.expected = expected
        problem.scale, evaluations = config.scale * config.narrowing**number, 0
        solver = SolverConfig(length, damping, even=True, kernel=charbonnier, settled=0.0)
        for found in minimise(problem.residuals, look, problem.moved, solver):
            shape, damping, done = found.state.shape, found.damping, done + 1
            terms = problem.terms(found.state, found.residuals)
            seconds, before, evaluations = time.perf_counter() - began, evaluations, problem.evaluations
            loss, code = sum(terms.values()), prior.code(shape.w)
            yield PhotoStep(start, done, loss, terms, code, seconds, evaluations - before, shape.place)
            began = time.perf_counter()
