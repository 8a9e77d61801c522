"""The initial placement and the initial codes: those whose shapes contradict the photographs least."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.fields.base import SDF, Counted
from distrace.photos.photo_set import PhotoSet
from distrace.photos.problem import PlacedShape
from distrace.photos.visual_hull import SILHOUETTE_SIZE, Masks, carve
from distrace.pose import Similarity
from distrace.render import render

SCREENING_RAYS = 400  # of all views, on which all training shapes are compared; the best of them are on 1,000

Coordinates = Float[Tensor, "dimensions"]


@dataclass
class Initialiser:
    """Ranks placements and training shapes by their loss on photographs; counts evaluations."""

    photos: PhotoSet
    seed: int = 0
    evaluations: int = 0

    @cached_property
    def training_shapes(self) -> list[Coordinates]:
        """The coordinates of the training codes."""
        prior = self.photos.prior
        return [prior.coordinates(code) for code in prior.codes]

    @property
    def mean_shape(self) -> Coordinates:
        """The coordinates of the mean."""
        return self.photos.prior.start(0, self.seed)

    def locate(self, photos: PhotoSet, place: Similarity) -> Similarity:
        """`locate` with the five training shapes nearest to the mean, or with the mean shape where there are none.

        `photos` are of full size: in coarse ones thin legs are lost.
        """
        prior = self.photos.prior
        typical = sorted(self.training_shapes, key=torch.norm)[:5] or [self.mean_shape]
        shapes = [Counted(self.photos.decoder.field(prior.code(w))) for w in typical]
        found = locate(photos, shapes, place)
        self.evaluations += sum(shape.evaluations for shape in shapes)
        return found

    def likelier(self, places: Sequence[Similarity]) -> Similarity:
        """The placement where the median loss of the mean shape and eight training shapes is the least."""
        training = self.training_shapes
        shapes = [self.mean_shape, *training[:: max(1, -(-len(training) // 8))]]
        return min(places, key=lambda place: median(self._losses(shapes, place, SCREENING_RAYS)))

    def ranked(self, place: Similarity) -> list[Coordinates]:
        """Coordinates of the best training shapes, the least loss first; the best eighth are compared on more rays."""
        shapes = self.training_shapes
        for rays in (SCREENING_RAYS, 1000):
            losses = self._losses(shapes, place, rays)
            order = sorted(range(len(shapes)), key=lambda number: losses[number])
            shapes = [shapes[number] for number in order[: max(len(self.training_shapes) // 8, 8)]]
        return shapes

    def starts(self, place: Similarity, count: int) -> list[Coordinates]:
        """Coordinates to start from: the mean's, those of the best training shapes, and a draw from the prior."""
        nearest = self.ranked(place)[: count - 2] if count > 2 else []
        draws = [self.photos.prior.start(k, self.seed) for k in range(1, count - len(nearest))]
        return [self.mean_shape, *nearest, *draws]

    def _losses(self, shapes: Sequence[Coordinates], place: Similarity, rays: int) -> list[float]:
        """The losses of colours and outlines, on the same rays for all shapes.

        Infinite where most views do not show the place or no ray hits the shape, since then nothing contradicts it.
        """
        cameras = self.photos.cameras
        showing = sum(bool(camera.shows(*camera.project(place.translation))) for camera in cameras)
        if 2 * showing < len(cameras):
            return [math.inf] * len(shapes)
        losses = []
        for w in shapes:
            random = torch.Generator().manual_seed(self.seed)
            problem, state = self.photos.problem(self.photos.sample(PlacedShape(w, place), rays, random))
            terms = problem.terms(state, problem.residuals(state))
            losses.append(terms["colour"] + terms["outline"] if state.hit.any() else math.inf)
            self.evaluations += problem.evaluations
        return losses


@torch.no_grad()
def locate(photos: PhotoSet, typical: Sequence[SDF], place: Similarity) -> Similarity:
    """The placement that aligns typical shapes' visual hulls with the observed one, in centre and radius.

    The observed hull is that of the masks or, without them, of pixels whose appearance is rare outside the unit
    sphere's image. All hulls contain what the views leave open, such as the space below an object seen from above.
    The rotation stays. Returns `place` where there is no hull.
    """
    every = -(-len(photos.cameras) // 12)  # a dozen views make a hull
    cameras = photos.cameras[::every]
    observed = _hull_extent(cameras, photos.object_masks()[::every], place)
    small = [camera.resized(min(1.0, SILHOUETTE_SIZE / max(camera.height, camera.width))) for camera in cameras]
    extents = []
    for sdf in typical:
        masks = [render(sdf, place.camera_in_object(camera)).mask for camera in small]
        if extent := _hull_extent(small, masks, place):
            extents.append(extent)
    if not extents or observed is None:
        return place
    centre, radius = (torch.stack(part).median(0).values for part in zip(*extents))  # one may have lost its legs
    growth = observed[1] / radius
    translation = observed[0] - growth * (centre - place.translation)
    return replace(place, translation=translation, scale=place.scale * growth)


def _hull_extent(
    cameras: Sequence[Camera], masks: Masks, place: Similarity
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]] | None:
    """Centre, in the world, of a visual hull's box along the object's axes, and the radius about it."""
    centres, solid = carve(cameras, masks, 64, tolerated=0.05)
    if solid.sum() < 2:
        return None
    points = centres[solid] @ place.rotation
    middle = (points.amin(0) + points.amax(0)) / 2
    return place.turned(middle), (points - middle).norm(dim=-1).max()
