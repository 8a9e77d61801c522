"""Photographs prepared for a fit: which rays are compared, what their pixels show, and which views see each point."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.fields.base import SDF, Counted
from distrace.fields.decoder import Decoder
from distrace.fitting.ray_sampling import drawn
from distrace.photos.colour_segmentation import ColourModel, appearance
from distrace.photos.problem import MARCH, NEARBY, ComparisonConfig, PhotoProblem, PlacedShape, TracedShape
from distrace.photos.stereo_pairs import GradientImage, neighbour_views, normalise_light
from distrace.photos.visual_hull import Masks, consistent_silhouettes
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.surface import normals
from distrace.tracing.sphere_tracing import Trace, sphere_trace

LEAST_COSINE = 0.2  # between a normal and the direction to another view that sees the point
LEAST_CERTAINTY = 0.3  # below it a pixel's label is unknown
NEAR_SURFACE = 0.1  # radii: background rays whose least value is larger are left out

Labels = Sequence[Float[Tensor, "height width"]]
"""Each view's certainty that a pixel shows the object, up to 1, or the background, down to −1; 0 where unknown."""


@dataclass(frozen=True)
class SampledRays:
    """Rays of all views, view by view, with a shape traced along them."""

    shape: PlacedShape
    sdf: Counted
    view: Int[Tensor, "n"]
    pixel: Int[Tensor, "n"]  # flat index in the view
    rays_world: Rays
    rays_object: Rays
    trace: Trace

    def read(self, images: Sequence[Float[Tensor, "height width channels"]]) -> Float[Tensor, "n channels"]:
        """The images' values, one image a view, at the rays' pixels."""
        flat = [image.flatten(0, 1)[self.pixel[self.view == view]] for view, image in enumerate(images)]
        return torch.cat(flat)


@dataclass(frozen=True)
class PhotoSet:
    """Photographs, and the model whose shapes are compared with them."""

    decoder: Decoder
    photographs: Sequence[Photograph]  # whose cameras see the unit sphere
    prior: Prior
    config: ComparisonConfig

    @cached_property
    def cameras(self) -> list[Camera]:
        """The photographs' cameras."""
        return [photograph.camera for photograph in self.photographs]

    @cached_property
    def masks(self) -> Masks | None:
        """The masks, where every photograph has one: then nothing need be segmented."""
        masks = [each.mask for each in self.photographs if each.mask is not None]
        return masks if len(masks) == len(self.photographs) else None

    @cached_property
    def images(self) -> list[GradientImage]:
        """The colours that are compared."""
        light = (lambda image: image) if self.config.same_light else normalise_light
        return [GradientImage.of(light(each.image), each.camera) for each in self.photographs]

    @cached_property
    def neighbours(self) -> Int[Tensor, "views count"]:
        """The views that each is compared with; −1 where there are fewer."""
        return neighbour_views(self.cameras, self.config.neighbours)

    @cached_property
    def appearances(self) -> list[Float[Tensor, "height width 4"]]:
        """What the segmentation distinguishes pixels by."""
        return [appearance(photograph.image) for photograph in self.photographs]

    @cached_property
    def meets(self) -> list[Bool[Tensor, "height width"]]:
        """Whether the pixels' rays meet the unit sphere."""
        return [meet_sphere(camera.rays()).meets for camera in self.cameras]

    @torch.no_grad()
    def sample(self, shape: PlacedShape, rays: int, random: torch.Generator) -> SampledRays:
        """Draws rays that meet the unit sphere, as many from each view, and traces a shape along them."""
        share = -(-rays // len(self.cameras))
        chosen = [drawn(meets.flatten().nonzero()[:, 0], share, random) for meets in self.meets]
        view = torch.cat([torch.full_like(pixels, number) for number, pixels in enumerate(chosen)])
        parts = [
            camera.rays(camera.pixels().flatten(0, 1)[pixels])
            for camera, pixels in zip(self.cameras, chosen, strict=True)
        ]
        rays_world = Rays.cat(parts)
        rays_object = shape.place.rays_in_object(rays_world)
        sdf = Counted(self.decoder.field(self.prior.code(shape.w)))
        trace = sphere_trace(sdf, rays_object, meet_sphere(rays_object), MARCH)
        return SampledRays(shape, sdf, view, torch.cat(chosen), rays_world, rays_object, trace)

    @torch.no_grad()
    def problem(self, sample: SampledRays, labels: Labels | None = None) -> tuple[PhotoProblem, TracedShape]:
        """The problem on sampled rays, and the shape's state; `labels` are by default the shape's own."""
        shape = sample.shape
        trace = sample.trace
        colour = sample.read([image.channels[:3].permute(1, 2, 0) for image in self.images])
        label = sample.read([label[..., None] for label in labels or self.labels(sample)])[:, 0]
        least = sample.sdf(sample.rays_object.at(trace.closest.nan_to_num(posinf=0.0)))
        used = (trace.hit | (label > 0) | (label < 0) & (least < NEAR_SURFACE)).nonzero()[:, 0]
        trace = trace[used]
        view = sample.view[used]
        compared = (trace.hit & (label[used] >= 0)).nonzero()[:, 0]
        points = sample.rays_object[used][compared].at(trace.distance[compared])
        rows, neighbours = self._visible(view[compared], shape.place, points, sample.sdf)
        problem = PhotoProblem(
            self.decoder,
            self.prior,
            self.config,
            self.images,
            sample.rays_world[used],
            view,
            colour[used],
            label[used],
            torch.stack([compared[rows], neighbours], dim=1),
            expected_place=shape.place,
            evaluations=sample.sdf.evaluations,
        )
        return problem, problem.trace(shape, TracedShape(shape, trace.closest, trace.hit, trace.hit))

    @torch.no_grad()
    def labels(self, sample: SampledRays) -> Labels:
        """Labels of all pixels: by masks where there are some, otherwise by the appearance of hits and misses.

        Pixels that look like the object where most other views rule it out are unknown.
        """
        if self.masks is not None:
            return [2.0 * mask - 1 for mask in self.masks]
        hit = sample.trace.hit
        seen = sample.read(self.appearances)
        outside = [looks[~meets] for looks, meets in zip(self.appearances, self.meets, strict=True)]
        background = torch.cat([seen[~hit], *outside])
        is_object = torch.cat([hit[hit], hit.new_zeros(len(background))])
        model = ColourModel.of(torch.cat([seen[hit], background]), is_object)
        certainties = [2 * model.smooth_probability(looks) - 1 for looks in self.appearances]
        silhouettes = consistent_silhouettes(self.cameras, [certainty > 0 for certainty in certainties])
        return [
            certainty.masked_fill((certainty > 0) & ~silhouette | (certainty.abs() < LEAST_CERTAINTY), 0.0)
            if photograph.mask is None
            else 2.0 * photograph.mask - 1
            for photograph, certainty, silhouette in zip(self.photographs, certainties, silhouettes, strict=True)
        ]

    def object_masks(self) -> Masks:
        """The masks or, without them, the pixels whose appearance is rare where rays miss the unit sphere."""
        if self.masks is not None:
            return self.masks
        model = ColourModel.of(
            torch.cat([looks.flatten(0, 1) for looks in self.appearances]),
            torch.cat([meets.flatten() for meets in self.meets]),
        )
        return [
            (model.smooth_probability(looks) > 0.6) & meets if photograph.mask is None else photograph.mask
            for photograph, looks, meets in zip(self.photographs, self.appearances, self.meets, strict=True)
        ]

    def _visible(
        self, view: Int[Tensor, "n"], place: Similarity, points_object: Float[Tensor, "n 3"], sdf: SDF
    ) -> tuple[Int[Tensor, "pairs"], Int[Tensor, "pairs"]]:
        """Pairs of a point and a neighbour of its view that sees it: not too flatly, within its image, unoccluded."""
        neighbours = self.neighbours[view]
        row, column = (neighbours >= 0).nonzero().T
        other = neighbours[row, column]
        points = points_object[row]
        normal = normals(sdf, points_object)[row]
        eyes = torch.stack([camera.T_world_camera[:3, 3] for camera in self.cameras])[other]
        to_eye = place.to_object(eyes) - points
        rays = Rays(points, to_eye / to_eye.norm(dim=-1, keepdim=True))
        visible = (rays.directions * normal).sum(-1) > LEAST_COSINE
        for number, camera in enumerate(self.cameras):
            in_view = other == number
            visible[in_view] &= camera.shows(*camera.project(place.to_world(points[in_view])))
        rays = rays[visible]
        to_sphere = Bounds(torch.full_like(rays.origins[:, 0], NEARBY), meet_sphere(rays).far)
        clear = ~sphere_trace(sdf, rays, to_sphere, MARCH).hit
        return row[visible][clear], other[visible][clear]
