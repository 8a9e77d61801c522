"""Where fits to photographs begin: in which place, and from which training shapes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch

from distrace.fields.base import Counted
from distrace.fields.decoder import Decoder
from distrace.photos.localisation import whereabouts
from distrace.photos.residuals import Shape
from distrace.photos.stage import Comparing, Stage
from distrace.pose import Similarity
from distrace.prior import Prior

SCREENED = 400  # rays on which all training shapes are compared, …
COMPARED = 1000  # … and those on which the best of them are: one in so many, and no fewer than
KEPT, FEWEST = 8, 8
TYPICAL = 5  # training shapes, nearest to the mean, that say how large an object is
ASKED = 8  # of them, of which place is the likelier


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

    def starts(self, stage: Stage, compared: Comparing, place: Similarity, count: int) -> list[torch.Tensor]:
        """The mean's coordinates, those of training shapes, and a draw."""
        few, wanted = replace(compared, rays=COMPARED), count - 2
        nearest = [w for _, w in self.ranked(stage, few, place)[:wanted]] if wanted > 0 else []
        draws = [self.prior.start(k, self.seed) for k in range(1, count - len(nearest))]
        return [self.prior.start(0, self.seed), *nearest, *draws]

    def _loss(self, stage: Stage, compared: Comparing, shape: Shape) -> float:
        """Of colours and outlines, on rays that are the same for all shapes; infinite where nothing is contradicted
        because most views do not show the shape, or no ray meets it."""
        random = torch.Generator().manual_seed(self.seed)
        problem, look = stage.problem(stage.glimpse(self.decoder, self.prior, shape, compared.rays, random), compared)
        terms = problem.terms(look, problem.residuals(look))
        self.evaluations += problem.evaluations
        middle = shape.place.translation
        showing = [view.camera.shows(*view.camera.project(middle)) for view in stage.photographs]
        seen = look.hit.any() and 2 * sum(map(bool, showing)) >= len(showing)
        return terms["colour"] + terms["outline"] if seen else math.inf
