"""From a field and a camera to images."""

import math
import warnings
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from distrace import surface
from distrace.camera import Camera
from distrace.equality import ByValue, summary
from distrace.errors import DoubtfulResult
from distrace.fields.base import SDF, check_field
from distrace.fields.batch import BatchField
from distrace.image_cache import Images, cached
from distrace.rays import Rays, meet_sphere
from distrace.tracing import coarse_to_fine as pyramid
from distrace.tracing.bounds import Occupancy
from distrace.tracing.sphere_tracing import MARCHES, Outcome, Trace, TraceConfig, sphere_trace
from distrace.tracing.tracer import TracerConfig, trace_images

FOOTPRINT = 10.0  # pixels: with narrower ones the derivatives of a ReLU network's normals are off by more than 10 %
WIDEST = 1 / 24  # of the radius: what coarse pixels cover is no longer one piece of surface
CLEARANCE_REACH = 0.02  # of the radius: the first step of the search for a ray's least value
DOUBTFUL_SHARE = 1e-3  # of the rays: more without an answer are worth a warning

Config = TraceConfig | TracerConfig
STRATEGIES: dict[str, Config] = {**MARCHES, "fast": TracerConfig()}


@dataclass(frozen=True, eq=False, repr=False)
class Buffers(ByValue):
    """The images that a camera sees of a field, as `render` returns them.

    Each image is computed on first use, and differentiable in the field and the camera. Images have the shape
    `[*batch, height, width]` of the camera; lengths are in the units of the world.
    """

    sdf: SDF | BatchField  # of one shape, or of the shape of each camera
    rays: Rays
    cosines: Float[Tensor, "*batch"]  # depth over distance
    trace: Trace
    radius: float
    occupancy: Occupancy | None = None  # the default tracer's, for other views of the same field
    pixel: Float[Tensor, "*batch"] | None = None  # the width that a pixel covers at a distance of 1
    images: Images = field(default_factory=Images, init=False, compare=False)

    def __repr__(self) -> str:
        hits = f"{int(self.mask.sum()):,} of {self.mask.numel():,} rays hit"
        return f"Buffers({summary(self.trace.distance)}, {hits}, radius={self.radius:g})"

    def _repr_png_(self) -> bytes | None:
        from distrace import notebook

        return notebook.strip_png(self.rays, self.trace.distance, self.cosines, self.field_at)

    @property
    def mask(self) -> Bool[Tensor, "*batch"]:
        return self.trace.hit

    def field_at(self, chosen: Bool[Tensor, "*batch"]) -> SDF:
        """Returns the field of the chosen rays, in their order; in a batch of shapes, the field of each ray's own."""
        if not isinstance(self.sdf, BatchField):
            return self.sdf
        return self.sdf.select(self._shapes(chosen))

    @property
    @cached
    def distance(self) -> Float[Tensor, "*batch"]:
        """Distance along the ray; `inf` where nothing was hit."""
        hit = self.trace.hit
        if not torch.is_grad_enabled():
            return self.trace.distance
        attached = surface.attach(self.field_at(hit), self.rays[hit], self.trace.distance[hit])
        return self.trace.distance.masked_scatter(hit, attached)

    @property
    @cached
    def depth(self) -> Float[Tensor, "*batch"]:
        """Depth z along the optical axis; `inf` where nothing was hit."""
        missed = ~self.trace.hit
        along = self.distance.masked_fill(missed, 0.0)  # inf times a zero gradient would be NaN
        return (along * self.cosines).masked_fill(missed, torch.inf)

    @property
    @cached
    def points(self) -> Float[Tensor, "hits 3"]:
        """The points that the rays of the mask hit, in the world."""
        return self.rays[self.mask].at(self.distance[self.mask])

    @property
    @cached
    def normal(self) -> Float[Tensor, "*batch 3"]:
        """Unit normals in world axes, zero where nothing was hit. One gradient of the field per hit."""
        normals = surface.normals(self.field_at(self.mask), self.points)
        return torch.zeros_like(self.rays.directions).masked_scatter(self.mask[..., None], normals)

    @property
    @cached
    def footprint_widths(self) -> Float[Tensor, "hits"]:
        """Diameters of the balls of footprint normals: FOOTPRINT pixels, at most WIDEST of the radius."""
        hit = self.trace.hit
        distance = self.distance[hit]
        widest = torch.full_like(distance, WIDEST * self.radius)
        return widest if self.pixel is None else widest.minimum(FOOTPRINT * distance * self.pixel.expand_as(hit)[hit])

    @property
    @cached
    def footprint_normal(self) -> Float[Tensor, "*batch 3"]:
        """Unit normals averaged over FOOTPRINT pixels, in world axes, zero where nothing was hit.

        Use them in a loss: on a ReLU network the derivative of `normal` is zero, and theirs is not. Costs 32
        evaluations per hit.
        """
        normals = surface.footprint_normals(self.field_at(self.mask), self.points, self.footprint_widths)
        return torch.zeros_like(self.rays.directions).masked_scatter(self.mask[..., None], normals)

    @property
    @cached
    def clearance(self) -> Float[Tensor, "*batch"]:
        """The least value of the field on each ray that misses, and its value at hits; `inf` outside of the bounds.

        Near the outline it is the minimum along the ray. Where the default tracer has excluded a block of pixels, it is
        the value at the least of the ray's coarse samples. Costs fewer evaluations than the render.
        """
        return self._least(torch.isfinite(self.trace.closest) & ~self.mask, self.mask)

    def clearance_near(self, pixels: int) -> Float[Tensor, "*batch height width"]:
        """Returns `clearance` of the rays within `pixels` of the outline, as losses use it; `inf` elsewhere."""
        inner = self.mask.to(self.cosines)[..., None, :, :]
        width = 2 * pixels + 1
        grown = max_pool2d(inner, width, 1, pixels)[..., 0, :, :] > 0
        shrunk = -max_pool2d(-inner, width, 1, pixels)[..., 0, :, :] > 0
        return self._least(grown & ~self.mask & torch.isfinite(self.trace.closest), self.mask & ~shrunk)

    def _least(self, missed: Bool[Tensor, "*batch"], hit: Bool[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        closest = self.trace.closest
        least = torch.full_like(closest, torch.inf)
        least = least.masked_scatter(hit, self.field_at(hit)(self.rays[hit].at(self.trace.distance[hit])))
        excluded = missed & (self.trace.evaluations == 0)
        if self.occupancy is not None and excluded.any():
            rays = self.rays[excluded]
            bounds = meet_sphere(rays.detach(), self.radius)
            lowest = self.occupancy.lowest(rays.detach(), bounds, self._shapes(excluded))
            least = least.masked_scatter(excluded, self.field_at(excluded)(rays.at(lowest)))
            missed = missed & ~excluded
        rays = self.rays[missed]
        bounds = meet_sphere(rays.detach(), self.radius)
        reach = 0.1 if self.occupancy is None else CLEARANCE_REACH * self.radius
        refine = None if self.occupancy is None else 3
        values = surface.clearance(self.field_at(missed), rays, closest[missed], bounds, reach=reach, refine=refine)
        return least.masked_scatter(missed, values)

    def _shapes(self, chosen: Bool[Tensor, "*batch"]) -> Int[Tensor, "n"]:
        """Returns the number of each chosen ray's shape in a batch; 0 of a single shape."""
        count = len(self.sdf) if isinstance(self.sdf, BatchField) else 1
        shape = torch.arange(count, device=chosen.device).reshape(-1, *[1] * (chosen.dim() - 1))
        return shape.expand(chosen.shape)[chosen]


def render(
    sdf: SDF | BatchField,
    camera: Camera,
    *,
    radius: float = 1.0,
    config: Config = TracerConfig(),
    occupancy: Occupancy | None = None,
) -> Buffers:
    """Renders a field inside a sphere of `radius` around the origin, as a camera sees it.

    `sdf` maps points [N, 3] to distances [N]. A field of B shapes (`model.field(codes)`) takes a batch of B cameras,
    and gives the images of B single calls. `radius` should tightly bound the surface: a configuration's lengths are
    relative to it. Pass `occupancy=buffers.occupancy` to render another view of the same field without measuring the
    field again.

    Gradients of depth, normal and clearance reach the field and the camera. Second derivatives are not exact.

    Warns `DoubtfulResult` where more than 0.1 % of the rays end without an answer, as they do where the field is NaN,
    or start inside. Raises `TypeError` for a model instead of its field, and `ValueError` for a radius that is not
    positive and finite, for a field that does not return one distance for each point, and for another number of cameras
    than of shapes.

    >>> from distrace.fields import primitives
    >>> radius = torch.tensor(0.5, requires_grad=True)
    >>> buffers = render(primitives.sphere(radius), Camera.orbit(0, 0, 4, height=15, width=15))
    >>> print(f"{buffers.depth[7, 7].item():.4f}")
    3.5000
    >>> buffers.depth[7, 7].backward()
    >>> print(f"{radius.grad.item():.4f}")
    -1.0000
    """
    if not 0 < radius < math.inf:
        raise ValueError(f"a radius of {radius} was given; the field lies in a sphere of positive, finite radius")
    check_field(sdf)
    rays, cosines, angle = camera.sight()
    if isinstance(config, TracerConfig):
        trace, occupancy = trace_images(sdf, camera, rays, radius, config, occupancy)
    elif isinstance(sdf, BatchField):
        raise ValueError(f"a field of {len(sdf)} shapes was given with {config}; only the default tracer takes several")
    else:
        trace = _marched(sdf, camera, rays, radius, config.within(radius))
        occupancy = None
    _warn(trace)
    return Buffers(sdf, rays, cosines, trace, radius, occupancy, angle)


def _marched(sdf: SDF, camera: Camera, rays: Rays, radius: float, config: TraceConfig) -> Trace:
    """Traces by one of the published strategies."""
    start, setup = pyramid.starts(sdf, camera, radius, config) if config.coarse_levels else (None, 0)
    steps = max(config.steps - config.coarse_levels * config.coarse_steps, 1)
    trace = sphere_trace(sdf, rays, meet_sphere(rays.detach(), radius), replace(config, steps=steps), start)
    return replace(trace, setup_evaluations=trace.setup_evaluations + setup)


def _warn(trace: Trace) -> None:
    """Warns of a picture that may be wrong."""
    exhausted = int((trace.outcome == Outcome.EXHAUSTED).sum())
    inside = int((trace.outcome == Outcome.INSIDE).sum())
    met = int(torch.isfinite(trace.closest).sum())
    if exhausted > DOUBTFUL_SHARE * met:
        warnings.warn(
            f"{exhausted} of {met} rays ended without an answer (EXHAUSTED): the field is NaN there, or steeper than"
            " its Lipschitz constant; give a larger `lipschitz`, or more steps to a published strategy",
            DoubtfulResult,
            stacklevel=3,
        )
    elif inside > DOUBTFUL_SHARE * met:
        warnings.warn(
            f"{inside} of {met} rays start inside the solid: is the camera in it, the solid larger than `radius`, the"
            " field's sign inverted (it is positive outside), or the field steeper than its Lipschitz constant?",
            DoubtfulResult,
            stacklevel=3,
        )


def render_rays(
    sdf: SDF, camera: Camera, pixels: Float[Tensor, "n 2"], *, radius: float = 1.0, config: TraceConfig = TraceConfig()
) -> Buffers:
    """Renders single pixel positions (x, y), as losses on sparse observations use them; without coarse levels.

    Raises `TypeError` for a model instead of its field.
    """
    check_field(sdf)
    rays, cosines, angle = camera.sight(pixels)
    trace = sphere_trace(sdf, rays, meet_sphere(rays.detach(), radius), config.within(radius))
    return Buffers(sdf, rays, cosines, trace, radius, pixel=angle)
