"""The whole way from a field and a camera to images, on one page."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace import pyramid, surface
from distrace.camera import Camera
from distrace.fast.lattice import Lattice
from distrace.fast.picture import FastConfig
from distrace.fast.tracer import fast_trace, near_surface
from distrace.field import SDF
from distrace.rays import Rays, meet_sphere
from distrace.trace import MARCHES, Trace, TraceConfig, sphere_trace

FOOTPRINT = 10.0  # pixels: with narrower ones the derivatives of a ReLU network's normals are off by more than 10 %
WIDEST = 1 / 20  # of the radius: what coarse pixels cover is no longer one piece of surface

Config = TraceConfig | FastConfig
Image = Callable[["Buffers"], Tensor]
STRATEGIES: dict[str, Config] = {**MARCHES, "fast": FastConfig()}


class _Shared(torch.autograd.Function):
    """The identity, for an image that others are made from; it explains why a second backward pass fails."""

    @staticmethod
    def forward(ctx: Any, shared: Tensor) -> Tensor:
        ctx.save_for_backward(shared.new_empty(0))
        return shared.view_as(shared)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        try:
            ctx.saved_tensors  # noqa: B018 – PyTorch raises where a backward pass has freed the graph
        except RuntimeError as error:
            raise RuntimeError(
                "the images of one rendering share a graph, which a backward pass has freed; add up the losses and"
                " call backward once, or pass retain_graph=True to every backward but the last"
            ) from error
        return slope


def _kept(image: Image) -> property:
    """Makes an image when it is first asked for; once with its gradients, and once without where grad mode is off."""

    @wraps(image)
    def read(buffers: "Buffers") -> Tensor:
        key = image.__name__, torch.is_grad_enabled()
        if key not in buffers.images:
            made = image(buffers)
            buffers.images[key] = _Shared.apply(made) if made.requires_grad else made
        return buffers.images[key]

    return property(read)


@dataclass(frozen=True)
class Buffers:
    """What a camera sees of a field. Images are made when first asked for, and differentiable in all that went in."""

    sdf: SDF
    rays: Rays
    cosines: Float[Tensor, "*batch"]  # depth over distance
    trace: Trace
    radius: float
    lattice: Lattice | None = None  # the fast tracer's, for other views of the same field
    pixel: Float[Tensor, "*batch"] | None = None  # the width that a pixel covers at a distance of 1
    images: dict[tuple[str, bool], Tensor] = field(default_factory=dict, init=False, repr=False)  # made so far

    @property
    def mask(self) -> Bool[Tensor, "*batch"]:
        return self.trace.hit

    @property
    def near(self) -> SDF:
        """The field, cheaper where there are hits if the tracer has learnt how."""
        return near_surface(self.sdf, self.lattice)

    @_kept
    def distance(self) -> Float[Tensor, "*batch"]:
        """Along the ray; `inf` where nothing was hit."""
        hit = self.trace.hit
        if not torch.is_grad_enabled():
            return self.trace.distance
        attached = surface.attach(self.near, self.rays[hit], self.trace.distance[hit])
        return self.trace.distance.masked_scatter(hit, attached)

    @_kept
    def depth(self) -> Float[Tensor, "*batch"]:
        """Along the optical axis; `inf` where nothing was hit."""
        missed = ~self.trace.hit
        along = self.distance.masked_fill(missed, 0.0)  # inf times a zero gradient would be NaN
        return (along * self.cosines).masked_fill(missed, torch.inf)

    @_kept
    def points(self) -> Float[Tensor, "hits 3"]:
        """Where the rays of the mask hit, in the world."""
        hit = self.trace.hit
        return self.rays[hit].at(self.distance[hit])

    @_kept
    def normal(self) -> Float[Tensor, "*batch 3"]:
        """Unit normals in world axes, zero where nothing was hit. One gradient of the field per hit."""
        hit = self.trace.hit[..., None].expand(*self.trace.hit.shape, 3)
        empty = torch.zeros_like(self.rays.directions)
        return empty.masked_scatter(hit, surface.normals(self.near, self.points))

    @_kept
    def footprint_widths(self) -> Float[Tensor, "hits"]:
        """Of the balls that footprint normals are averaged over: FOOTPRINT pixels, at most WIDEST of the radius."""
        hit = self.trace.hit
        distance = self.distance[hit]
        widest = torch.full_like(distance, WIDEST * self.radius)
        return widest if self.pixel is None else widest.minimum(FOOTPRINT * distance * self.pixel.expand_as(hit)[hit])

    @_kept
    def footprint_normal(self) -> Float[Tensor, "*batch 3"]:
        """Unit normals averaged over a few pixels, in world axes, zero where nothing was hit.

        Use them in a loss: they have a useful derivative also on a ReLU network, where that of `normal` is zero. Costs
        32 evaluations per hit.
        """
        hit = self.trace.hit[..., None].expand(*self.trace.hit.shape, 3)
        empty = torch.zeros_like(self.rays.directions)
        return empty.masked_scatter(hit, surface.footprint_normals(self.near, self.points, self.footprint_widths))

    @_kept
    def clearance(self) -> Float[Tensor, "*batch"]:
        """The least sdf on each ray that misses, and sdf at hits; `inf` where a ray never meets the bounds.

        Costs evaluations. Without the fast tracer's lattice it is the minimum beside the march's sample.
        """
        met, hit = torch.isfinite(self.trace.closest), self.trace.hit
        least = torch.full_like(self.trace.closest, torch.inf)
        least = least.masked_scatter(hit, self.near(self.rays[hit].at(self.trace.distance[hit])))
        missed = met & ~hit
        rays, closest = self.rays[missed], self.trace.closest[missed]
        bounds = meet_sphere(rays.detach(), self.radius)
        other = self.lattice and self.lattice.lowest(rays.detach(), bounds, closest)
        return least.masked_scatter(missed, surface.clearance(self.sdf, rays, closest, bounds, other))


def render(
    sdf: SDF,
    camera: Camera,
    *,
    radius: float = 1.0,
    config: Config = FastConfig(),
    lattice: Lattice | None = None,
    last: Trace | None = None,
) -> Buffers:
    """Renders a field inside a sphere of `radius` around the origin, as a camera sees it.

    The gradients of depth, normal and clearance reach whatever requires grad in the field and the camera; those of
    these gradients, by `create_graph`, are not exact. The fast tracer takes over what a rendering before has learnt:
    `lattice`, of the same field, and `last`, the trace of nearly the same field by nearly the same camera. Give a
    radius about as large as what there is to see, for a configuration's lengths are parts of it, but tolerances that
    are told for each ray. Raises `ValueError` for a radius that is not positive and finite, and for a field that does
    not give one distance for each point.
    """
    if not 0 < radius < math.inf:
        raise ValueError(f"a radius of {radius} was given; the field lies in a sphere of positive, finite radius")
    rays = camera.rays()
    if isinstance(config, FastConfig):
        trace, lattice = fast_trace(sdf, camera, radius, config, lattice, last)
        return Buffers(sdf, rays, camera.cosines(), trace, radius, lattice, camera.pixel_angle())
    config = config.within(radius)
    start, setup = pyramid.starts(sdf, camera, radius, config) if config.coarse_levels else (None, 0)
    steps = max(config.steps - config.coarse_levels * config.coarse_steps, 1)
    trace = sphere_trace(sdf, rays, meet_sphere(rays.detach(), radius), replace(config, steps=steps), start)
    trace = replace(trace, setup_evaluations=trace.setup_evaluations + setup)
    return Buffers(sdf, rays, camera.cosines(), trace, radius, pixel=camera.pixel_angle())


def render_each(sdfs: Sequence[SDF], cameras: Camera | Sequence[Camera], **options: Any) -> list[Buffers]:
    """Several fields, each as its own camera sees it, or all as one does: `render` of each, with its options.

    Raises `ValueError` for another number of cameras than of fields. (Several cameras of one field are a batch of
    `Camera`, which `render` takes.)
    """
    cameras = [cameras] * len(sdfs) if isinstance(cameras, Camera) else cameras
    if len(cameras) != len(sdfs):
        raise ValueError(
            f"{len(sdfs)} fields and {len(cameras)} cameras were given; give one camera, or as many as fields"
        )
    return [render(sdf, camera, **options) for sdf, camera in zip(sdfs, cameras, strict=True)]


def render_rays(
    sdf: SDF, camera: Camera, pixels: Float[Tensor, "n 2"], *, radius: float = 1.0, config: TraceConfig = TraceConfig()
) -> Buffers:
    """The same for some pixel positions (x, y) alone: what a loss on sparse observations needs. No coarse levels."""
    rays = camera.rays(pixels)
    trace = sphere_trace(sdf, rays, meet_sphere(rays.detach(), radius), config.within(radius))
    return Buffers(sdf, rays, camera.cosines(pixels), trace, radius, pixel=camera.pixel_angle(pixels))
