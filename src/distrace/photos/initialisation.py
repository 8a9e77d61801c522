"""The initial placement and the initial codes: those whose shapes contradict the photographs least."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF, Counted
from distrace.fields.decoder import Decoder
from distrace.photos.colour_segmentation import ColourModel
from distrace.photos.pyramid import PyramidLevel
from distrace.photos.residuals import ComparisonConfig, PlacedShape
from distrace.photos.visual_hull import carve
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.render import render

SCREENING_RAYS = 400  # on which all training shapes are compared
RANKING_RAYS = 1000  # on which the best of them are: …
SCREENED_SHARE = 8  # … one in so many, …
SCREENED_LEAST = 8  # … and at least so many
TYPICAL_SHAPES = 5  # training shapes, nearest to the mean, that tell an object's usual size
PLACE_SHAPES = 8  # training shapes, at most, that compare placements
HULL_CELLS = 64  # along each axis of the cube around the unit sphere
CLEAR_PROBABILITY = 0.6  # from which a pixel is object: a background's is below one half
SILHOUETTE_SIZE = 96  # pixels along the longer side, of typical shapes' masks: at 48 thin legs were lost
LARGEST_GROWTH = 4.0  # a hull × larger or smaller than typical ones is a mark on the object, or the background
HULL_VIEWS = 12  # views, at most, that make a hull


@dataclass
class Initialiser:
    """Ranks placements and training shapes by their loss on photographs; counts evaluations."""

    decoder: Decoder
    prior: Prior
    seed: int = 0
    evaluations: int = 0

    def locate(self, level: PyramidLevel, place: Similarity) -> Similarity:
        """`locate` with the training shapes nearest to the mean, or with the mean shape where there are none."""
        prior = self.prior
        typical = sorted((prior.coordinates(code) for code in prior.codes), key=torch.norm)[:TYPICAL_SHAPES]
        shapes = [Counted(self.decoder.field(prior.code(w))) for w in typical or [prior.start(0, self.seed)]]
        found = locate(level, shapes, place)
        self.evaluations += sum(shape.evaluations for shape in shapes)
        return found

    def likelier(self, level: PyramidLevel, config: ComparisonConfig, places: Sequence[Similarity]) -> Similarity:
        """The placement where the median loss of a few training shapes is the least."""
        config = replace(config, rays=SCREENING_RAYS)
        codes = self.prior.codes[:: max(1, -(-len(self.prior.codes) // PLACE_SHAPES))]
        shapes = [self.prior.start(0, self.seed), *(self.prior.coordinates(code) for code in codes)]
        return min(places, key=lambda place: median(self._loss(level, config, PlacedShape(w, place)) for w in shapes))

    def ranked(
        self, level: PyramidLevel, config: ComparisonConfig, place: Similarity
    ) -> list[Float[Tensor, "dimensions"]]:
        """Coordinates of the best training shapes, the least loss first; all are screened on fewer rays."""
        coordinates = [self.prior.coordinates(code) for code in self.prior.codes]
        for rays in (min(SCREENING_RAYS, config.rays), config.rays):
            losses = [self._loss(level, replace(config, rays=rays), PlacedShape(w, place)) for w in coordinates]
            order = sorted(range(len(coordinates)), key=lambda number: losses[number])
            count = max(len(self.prior.codes) // SCREENED_SHARE, SCREENED_LEAST)
            coordinates = [coordinates[number] for number in order[:count]]
        return coordinates

    def starts(
        self, level: PyramidLevel, config: ComparisonConfig, place: Similarity, count: int
    ) -> list[Float[Tensor, "dimensions"]]:
        """Coordinates to start from: the mean's, those of the best training shapes, and a draw from the prior."""
        ranked = self.ranked(level, replace(config, rays=RANKING_RAYS), place) if count > 2 else []
        nearest = ranked[: max(count - 2, 0)]
        draws = [self.prior.start(k, self.seed) for k in range(1, count - len(nearest))]
        return [self.prior.start(0, self.seed), *nearest, *draws]

    def _loss(self, level: PyramidLevel, config: ComparisonConfig, shape: PlacedShape) -> float:
        """The loss of colours and outlines, on the same rays for all shapes.

        Infinite where most views do not show the shape or no ray hits it, since then nothing contradicts it.
        """
        random = torch.Generator().manual_seed(self.seed)
        sample = level.sample(self.decoder, self.prior, shape, config.rays, random)
        problem, state = level.problem(sample, config)
        terms = problem.terms(state, problem.residuals(state))
        self.evaluations += problem.evaluations
        centre = shape.place.translation
        showing = [bool(view.camera.shows(*view.camera.project(centre))) for view in level.photographs]
        visible = state.hit.any() and 2 * sum(showing) >= len(showing)
        return terms["colour"] + terms["outline"] if visible else math.inf


def locate(level: PyramidLevel, typical: Sequence[SDF], place: Similarity) -> Similarity:
    """The placement that aligns typical shapes' visual hulls with the observed one, in centre and radius.

    The observed hull is that of the masks or, without them, of pixels whose appearance is rare outside the unit
    sphere's image. Both hulls contain what the views leave open, such as the space below an object seen from above.
    The rotation stays. Returns `place` where there is no hull, or one of an unlikely size.
    """
    masked = [
        view if view.mask is not None else replace(view, mask=mask)
        for view, mask in zip(level.photographs, _object_masks(level), strict=True)
    ]
    masked = masked[:: -(-len(masked) // HULL_VIEWS)]
    coarse = [view.at_most(SILHOUETTE_SIZE) for view in masked]
    extents = []
    for sdf in typical:
        with torch.no_grad():
            silhouettes = [render(sdf, place.camera_in_object(view.camera)).mask for view in coarse]
        views = [replace(view, mask=mask) for view, mask in zip(coarse, silhouettes, strict=True)]
        if extent := _hull_extent(views, place):
            extents.append(extent)
    observed = _hull_extent(masked, place)
    if not extents or observed is None:
        return place
    centre, radius = (torch.stack(part).median(0).values for part in zip(*extents))  # one may have lost its legs
    growth = observed[1] / radius
    if not 1 / LARGEST_GROWTH < growth < LARGEST_GROWTH:
        return place
    translation = observed[0] - growth * (centre - place.translation)
    return replace(place, translation=translation, scale=place.scale * growth)


def _hull_extent(views: Sequence[Photograph], place: Similarity) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]] | None:
    """Centre, in the world, of a visual hull's box along the object's axes, and the radius about it."""
    centres, solid = carve(views, HULL_CELLS)
    if solid.sum() < 2:
        return None
    points = centres[solid] @ place.rotation
    middle = (points.amin(0) + points.amax(0)) / 2
    return place.turned(middle), (points - middle).norm(dim=-1).max()


def _object_masks(level: PyramidLevel) -> list[Bool[Tensor, "height width"]]:
    """Pixels whose appearance is rare among pixels whose rays miss the unit sphere."""
    appearances = torch.cat([each.reshape(-1, 4) for each in level.appearances])
    model = ColourModel.of(appearances, torch.cat(list(level.meets)))
    return [
        (model.smooth_probability(each) > CLEAR_PROBABILITY) & meets.reshape(each.shape[:2])
        for each, meets in zip(level.appearances, level.meets, strict=True)
    ]
