"""A traced view, seen again of a moved field or by a moved camera: as the renderer attaches it, and traced anew."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace import surface
from distrace.camera import Camera
from distrace.checking.differences import Images
from distrace.fields.base import SDF, value_and_gradient
from distrace.pixels import thinned
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.render import Buffers
from distrace.tracing.sphere_tracing import Outcome, Trace, TraceConfig, sphere_trace

CAREFUL = TraceConfig(steps=300, step_scale=1.0, coarse_levels=0)
CHORDS = 3
ROUNDS = 4  # in which a minimum is enclosed
REACH = 50  # steps that a zero or a minimum may move by
EDGE = 1e-3  # a minimum closer to the bounds is none
MOST = 128  # rays that pass by; a minimum costs several times what a zero does


@dataclass(frozen=True)
class Precision:
    """What can be told of derivatives in numbers of a kind."""

    dtype: torch.dtype
    step: float
    zero: float  # to which distances are found
    tolerance: float  # relative errors up to which derivatives agree, and one-sided differences make no kink
    least: float  # derivatives below it are measured against it


DOUBLE = Precision(torch.float64, step=1e-6, zero=1e-11, tolerance=1e-3, least=1e-3)
SINGLE = Precision(torch.float32, step=2e-3, zero=1e-5, tolerance=5e-2, least=5e-2)


@dataclass(frozen=True)
class Retraced:
    """Where the rays of a camera hit a field, and where the others come closest to it."""

    trace: Trace
    slope: Float[Tensor, "hits"]  # of f along the ray
    passing: Bool[Tensor, "height width"]  # some rays that enter the bounds and hit nothing
    closest: Float[Tensor, "misses"]  # the least value on them; NaN where that is on the bounds
    radius: float
    precision: Precision

    @staticmethod
    def of(sdf: SDF, camera: Camera, radius: float, precision: Precision) -> "Retraced":
        """Raises `ValueError` where the camera sees nothing of the shape."""
        rays = camera.rays()
        bounds = meet_sphere(rays, radius)
        trace = sphere_trace(sdf, rays, bounds, CAREFUL)
        if not trace.hit.any():
            raise ValueError("the camera sees nothing of this shape; there is no derivative to check")
        trace, slope = _exact(sdf, camera, trace, precision)
        passing = thinned((trace.outcome == Outcome.ESCAPED) & bounds.meets, MOST)
        trace = replace(trace, closest=trace.closest.masked_fill(~(passing | trace.hit), torch.inf))
        missing, within = rays[passing], Bounds(bounds.near[passing], bounds.far[passing])
        rough = surface.minimum(sdf, missing, trace.closest[passing], within)
        closest = surface.minimum(sdf, missing, rough, within, reach=EDGE, refine=2 * ROUNDS)
        outside = (closest - within.near < EDGE) | (within.far - closest < EDGE)
        return Retraced(trace, slope, passing, closest.masked_fill(outside, torch.nan), radius, precision)

    def attached(self, sdf: SDF, camera: Camera) -> Images:
        """By the renderer, from the trace as it was: differentiable."""
        buffers = Buffers(sdf, camera.rays(), camera.cosines(), self.trace, self.radius)
        return self._hits(buffers) | {"clearance": buffers.clearance[self.passing]}

    @torch.no_grad()
    def traced_anew(self, sdf: SDF, camera: Camera) -> Images:
        """Of the zeros and minima beside those of the trace; NaN where there are none."""
        least = least_beside(sdf, camera.rays()[self.passing], self.closest, REACH * self.precision.step)
        return self.hits_anew(sdf, camera) | {"clearance": least}

    @torch.no_grad()
    def hits_anew(self, sdf: SDF, camera: Camera) -> Images:
        """The same, but for the clearance."""
        rays, hit = camera.rays(), self.trace.hit
        found = zero_beside(sdf, rays[hit], self.trace.distance[hit], self.slope, self.precision.zero)
        trace = replace(self.trace, distance=self.trace.distance.masked_scatter(hit, found))
        return self._hits(Buffers(sdf, rays, camera.cosines(), trace, self.radius))

    def pixels(self, quantity: str) -> Tensor:
        """The (x, y) of a quantity's elements."""
        return (self.passing if quantity == "clearance" else self.trace.hit).nonzero().flip(-1)

    def _hits(self, buffers: Buffers) -> Images:
        hit = self.trace.hit
        flat = {"distance": buffers.distance[hit], "depth": buffers.depth[hit]}
        return flat | {"hit points": buffers.points, "normal": buffers.normal[hit]}


@torch.no_grad()
def zero_beside(
    sdf: SDF,
    rays: Rays,
    distance: Float[Tensor, "*batch"],
    slope: Float[Tensor, "*batch"],
    precision: float,
    chords: int = CHORDS,
) -> Float[Tensor, "*batch"]:
    """The zero of f on each ray beside a distance at which f has a slope; NaN where chords do not end at one."""
    last = distance
    for _ in range(chords):
        last, distance = distance, distance - sdf(rays.at(distance)) / slope
    return distance.masked_fill(~((distance - last).abs() < precision), torch.nan)


@torch.no_grad()
def least_beside(sdf: SDF, rays: Rays, closest: Float[Tensor, "n"], reach: float) -> Float[Tensor, "n"]:
    """The least value of f on each ray beside a distance: where the lines on both sides of the minimum cross.

    A network of ReLUs is linear between kinks, and then that is its minimum, which no sample meets.
    """
    t, value = surface.minimum_and_value(sdf, rays, closest, reach=reach, refine=ROUNDS)
    w = 3 * reach / 5**ROUNDS
    far_left, left, right, far_right = (sdf(rays.at(t + k * w)) for k in (-2, -1, 1, 2))
    falls, rises = (left - far_left) / w, (far_right - right) / w
    encloses = (falls < 0) & (rises > 0)
    offset = (left - right + (falls + rises) * w) / torch.where(encloses, rises - falls, 1.0)
    return torch.where(encloses, left + falls * (offset + w), value)


@torch.no_grad()
def _exact(sdf: SDF, camera: Camera, trace: Trace, precision: Precision) -> tuple[Trace, Tensor]:
    """The trace with its hits at the zeros of f, without those that have none, and the slopes of f along the rays."""
    rays, hit = camera.rays(), trace.hit
    rays, distance = rays[hit], trace.distance[hit]
    _, gradient = value_and_gradient(sdf, rays.at(distance))
    slope = (gradient * rays.directions).sum(-1)
    distance = zero_beside(sdf, rays, distance, slope, precision.zero)
    lost = distance.isnan()
    outcome = trace.outcome.masked_scatter(hit, torch.where(lost, int(Outcome.EXHAUSTED), trace.outcome[hit]))
    exact = trace.distance.masked_scatter(hit, distance.masked_fill(lost, torch.inf))
    closest = trace.closest.masked_scatter(hit, torch.where(lost, trace.closest[hit], distance))
    return replace(trace, distance=exact, outcome=outcome, closest=closest), slope[~lost]
