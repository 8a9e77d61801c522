"""One level of the pyramid of photographs: rays drawn, pixels told apart by colour, and which view sees which point."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF, Counted
from distrace.fields.decoder import Decoder
from distrace.fitting.ray_sampling import drawn
from distrace.photos.colour_segmentation import Regions, appearance
from distrace.photos.cross_view_consistency import Consensus
from distrace.photos.residuals import MARCH, Look, PhotoProblem, PhotoWeights, Shape, Sightings
from distrace.photos.stereo_pairs import Colours, partners, without_light
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.surface import normals
from distrace.tracing.sphere_tracing import Trace, sphere_trace

LEAVING = 0.03  # from a surface point towards another view, before a surface in between can hide it
FACING = 0.2  # the least cosine between a normal and the direction to another view
DOUBT = 0.3  # a colour whose certainty is less tells nothing
WATCHED = 0.1  # rays of the background that come no closer than this are left out

Labels = Sequence[Float[Tensor, "height width"]]
"""Of each view, how certain it is that a pixel shows the object, 1, or the background, -1; 0 where nothing tells."""


@dataclass(frozen=True)
class Comparing:
    """How photographs are compared."""

    rays: int = 4000  # of all views
    partners: int = 4  # of each view
    weights: PhotoWeights = PhotoWeights()
    moves: bool = True  # whether the shape's place is unknown, too
    same_light: bool = True  # otherwise colours are compared without their local mean and contrast

    def __post_init__(self) -> None:
        if self.rays < 1 or self.partners < 1:
            raise ValueError(f"{self.rays} rays and {self.partners} partners were asked for; both must be at least 1")


@dataclass(frozen=True)
class Glimpse:
    """Rays of all views, view by view, and where a shape is along them."""

    decoder: Decoder
    prior: Prior
    shape: Shape
    sdf: Counted
    view: Int[Tensor, "n"]
    index: Int[Tensor, "n"]  # of the pixel
    rays: Rays  # in the world
    in_object: Rays
    trace: Trace


@dataclass(frozen=True)
class Stage:
    """Photographs at one level of the pyramid."""

    photographs: Sequence[Photograph]
    pictures: Sequence[Colours]  # what is compared of them
    partners: Int[Tensor, "views count"]  # to compare each view with; -1 where there are fewer
    looks: Sequence[Float[Tensor, "height width 4"]]  # by which object and background are told apart
    meets: Sequence[Bool[Tensor, "pixels"]]  # whether the pixels' rays meet the unit sphere
    consensus: Consensus  # on what can be the object

    @staticmethod
    def of(photographs: Sequence[Photograph], level: float, config: Comparing) -> "Stage":
        coarse = [photograph.resized(level) for photograph in photographs]
        images = [each.image if config.same_light else without_light(each.image) for each in coarse]
        pictures = [Colours.of(image, each.camera) for image, each in zip(images, coarse, strict=True)]
        cameras, looks = [each.camera for each in coarse], [appearance(each.image) for each in coarse]
        meets = [meet_sphere(camera.rays()).meets.reshape(-1) for camera in cameras]
        return Stage(coarse, pictures, partners(cameras, config.partners), looks, meets, Consensus.of(cameras))

    @torch.no_grad()
    def glimpse(self, decoder: Decoder, prior: Prior, shape: Shape, rays: int, random: torch.Generator) -> Glimpse:
        """A shape along rays drawn anew, as many of each view."""
        view, index = self._drawn(rays, random)
        world = self._rays(view, index)
        in_object, sdf = shape.place.rays_in_object(world), Counted(decoder.field(prior.code(shape.w)))
        trace = sphere_trace(sdf, in_object, meet_sphere(in_object), MARCH)
        return Glimpse(decoder, prior, shape, sdf, view, index, world, in_object, trace)

    @torch.no_grad()
    def problem(self, glimpse: Glimpse, config: Comparing, labels: Labels | None = None) -> tuple[PhotoProblem, Look]:
        """What the glimpse's pixels show by `labels`, else as the shape has it, and who else sees that."""
        shape, sdf, view, trace = glimpse.shape, glimpse.sdf, glimpse.view, glimpse.trace
        compared = self._read(view, glimpse.index, [each.channels[:3].permute(1, 2, 0) for each in self.pictures])
        labels = labels or self.labels(glimpse)
        sure = self._read(view, glimpse.index, [each[..., None] for each in labels])[:, 0]
        far = ~trace.hit & (sdf(glimpse.in_object.at(trace.closest.nan_to_num(posinf=0.0))) > WATCHED)
        kept = (trace.hit | (sure > 0) | (sure < 0) & ~far).nonzero()[:, 0]
        seen = Sightings(glimpse.rays, view, compared, sure)[kept]
        view, in_object, trace = view[kept], glimpse.in_object[kept], trace[kept]
        asked = (trace.hit & (seen.certainty >= 0)).nonzero()[:, 0]
        visible = self._visible(view[asked], shape.place, in_object[asked].at(trace.distance[asked]), sdf)
        pairs = torch.stack([asked[visible[0]], visible[1]], dim=1)
        problem = PhotoProblem(
            glimpse.decoder, glimpse.prior, seen, self.pictures, pairs, config.weights, config.moves, shape.place
        )
        problem.evaluations += sdf.evaluations
        return problem, problem.look(shape, Look(shape, trace.closest, trace.hit, trace.hit))

    @torch.no_grad()
    def labels(self, glimpse: Glimpse) -> Labels:
        """What the pixels of each view show, as a shape would have it.

        By the masks where there are some, otherwise by appearance: that of hits against all others. What looks like
        the object where most other views rule it out says nothing.
        """
        asked, hit = self._read(glimpse.view, glimpse.index, self.looks), glimpse.trace.hit
        beyond = [looks.reshape(-1, 4)[~meets] for looks, meets in zip(self.looks, self.meets, strict=True)]
        background = torch.cat([asked[~hit], *beyond])
        is_object = torch.cat([hit[hit], hit.new_zeros(len(background))])
        regions = Regions.of(torch.cat([asked[hit], background]), is_object)
        images = [2 * regions.smooth_probability(looks) - 1 for looks in self.looks]
        possible = self.consensus.agreed([image > 0 for image in images])
        return [
            image.masked_fill((image > 0) & ~shown | (image.abs() < DOUBT), 0.0)
            if each.mask is None
            else 2.0 * each.mask - 1
            for each, image, shown in zip(self.photographs, images, possible, strict=True)
        ]

    def _drawn(self, count: int, random: torch.Generator) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
        """As many pixels of each view, of those whose rays meet the unit sphere."""
        share = -(-count // len(self.photographs))
        chosen = [drawn(meets.nonzero()[:, 0], share, random) for meets in self.meets]
        return torch.cat([torch.full_like(some, number) for number, some in enumerate(chosen)]), torch.cat(chosen)

    def _rays(self, view: Int[Tensor, "n"], index: Int[Tensor, "n"]) -> Rays:
        """Of pixels, view by view."""
        cameras = [each.camera for each in self.photographs]
        parts = [
            camera.rays(camera.pixels().reshape(-1, 2)[index[view == number]]) for number, camera in enumerate(cameras)
        ]
        return Rays(torch.cat([part.origins for part in parts]), torch.cat([part.directions for part in parts]))

    def _read(
        self, view: Int[Tensor, "n"], index: Int[Tensor, "n"], images: Sequence[Float[Tensor, "height width channels"]]
    ) -> Float[Tensor, "n channels"]:
        """What images have at pixels, view by view."""
        parts = [image.reshape(-1, image.shape[-1])[index[view == number]] for number, image in enumerate(images)]
        return torch.cat(parts)

    def _visible(
        self, view: Int[Tensor, "n"], place: Similarity, points_object: Float[Tensor, "n 3"], sdf: SDF
    ) -> tuple[Int[Tensor, "pairs"], Int[Tensor, "pairs"]]:
        """Points, and the partners of their views that see them: from before, in their image, with nothing between."""
        partner = self.partners[view]
        row, column = (partner >= 0).nonzero().T
        other = partner[row, column]
        points, normal = points_object[row], normals(sdf, points_object)[row]
        eyes = torch.stack([picture.camera.T_world_camera[:3, 3] for picture in self.pictures])[other]
        to_eye = place.to_object(eyes) - points
        rays = Rays(points, to_eye / to_eye.norm(dim=-1, keepdim=True))
        seen = (rays.directions * normal).sum(-1) > FACING
        for number, picture in enumerate(self.pictures):
            some = other == number
            seen[some] &= picture.camera.shows(*picture.camera.project(place.to_world(points[some])))
        row, other, rays = row[seen], other[seen], rays[seen]
        leaving = Bounds(torch.full_like(rays.origins[:, 0], LEAVING), meet_sphere(rays).far)
        clear = ~sphere_trace(sdf, rays, leaving, MARCH).hit
        return row[clear], other[clear]
