"""A traced view, rendered again for a moved field or camera: attached as the renderer does, or retraced.

Footprint normals are compared at fewer hits, over longer steps.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace import surface
from distrace.camera import Camera
from distrace.checking.differences import Images, differences, image_derivatives
from distrace.checking.moves import Move
from distrace.fields.base import SDF, value_and_gradient
from distrace.pixels import thinned
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.render import Buffers
from distrace.tracing.sphere_tracing import Outcome, Trace, TraceConfig, sphere_trace

CAREFUL = TraceConfig(steps=300, step_scale=1.0, coarse_levels=0)
CHORDS = 3  # steps of the chord method towards a root
ROUNDS = 4  # of bracketing a minimum
REACH = 50  # difference steps that a minimum may move by
EDGE = 1e-3  # radii: a minimum closer to the bounds counts as none
MOST_MISSES = 128  # rays whose clearance is compared; a minimum costs several times what a root does
MOST_FOOTPRINTS = 256  # hits whose footprint normal is compared
FOOTPRINT_CHORDS = 10  # more than CHORDS, since the steps are longer
STEP_OF_VIEW = 1 / 20  # footprint widths to each side, for moves of the camera or of the shape
STEP_OF_FIELD = 1 / 400  # the same for changes of the field, whose distances are not linear over longer steps


@dataclass(frozen=True)
class Precision:
    """The steps and tolerances that a floating-point type allows."""

    dtype: torch.dtype
    step: float  # of the differences, in h
    zero: float  # error of a root, in radii
    tolerance: float  # relative: derivatives agree up to it, and one-sided differences that differ more make a kink
    least: float  # the scale of relative errors is never below it


DOUBLE = Precision(torch.float64, step=1e-6, zero=1e-11, tolerance=1e-3, least=1e-3)
SINGLE = Precision(torch.float32, step=2e-3, zero=1e-5, tolerance=5e-2, least=5e-2)


@dataclass(frozen=True)
class Retraced:
    """The hits of a camera's rays on a field, and the minima of the field on rays that miss."""

    trace: Trace
    slope: Float[Tensor, "hits"]  # of f along the ray
    passing: Bool[Tensor, "height width"]  # at most MOST_MISSES rays that enter the bounds and miss
    closest: Float[Tensor, "misses"]  # distance of the minimum on them; NaN where it lies on the bounds
    radius: float
    precision: Precision

    @staticmethod
    def of(sdf: SDF, camera: Camera, radius: float, precision: Precision) -> "Retraced":
        """Traces the view. Raises `ValueError` where no ray hits the shape."""
        rays = camera.rays()
        bounds = meet_sphere(rays, radius)
        trace = sphere_trace(sdf, rays, bounds, CAREFUL)
        if not trace.hit.any():
            raise ValueError("the camera sees nothing of this shape; there is no derivative to check")
        trace, slope = _refined(sdf, camera, trace, precision)
        passing = thinned((trace.outcome == Outcome.ESCAPED) & bounds.meets, MOST_MISSES)
        trace = replace(trace, closest=trace.closest.masked_fill(~(passing | trace.hit), torch.inf))
        misses = rays[passing]
        within = Bounds(bounds.near[passing], bounds.far[passing])
        rough = surface.minimum(sdf, misses, trace.closest[passing], within)
        closest = surface.minimum(sdf, misses, rough, within, reach=EDGE, refine=2 * ROUNDS)
        on_bounds = (closest - within.near < EDGE) | (within.far - closest < EDGE)
        return Retraced(trace, slope, passing, closest.masked_fill(on_bounds, torch.nan), radius, precision)

    def attached(self, sdf: SDF, camera: Camera) -> Images:
        """Returns the renderer's images on the trace's hits and minima, differentiable in field and camera."""
        buffers = Buffers(sdf, camera.rays(), camera.cosines(), self.trace, self.radius)
        return self._hit_images(buffers) | {"clearance": buffers.clearance[self.passing]}

    @torch.no_grad()
    def retraced(self, sdf: SDF, camera: Camera) -> Images:
        """Returns the images on the roots and minima next to the trace's; NaN where there are none."""
        least = minimum_near(sdf, camera.rays()[self.passing], self.closest, REACH * self.precision.step)
        return self.retraced_hits(sdf, camera) | {"clearance": least}

    @torch.no_grad()
    def retraced_hits(self, sdf: SDF, camera: Camera) -> Images:
        """Returns the images of `retraced` without the clearance."""
        rays = camera.rays()
        hit = self.trace.hit
        roots = root_near(sdf, rays[hit], self.trace.distance[hit], self.slope, self.precision.zero)
        trace = replace(self.trace, distance=self.trace.distance.masked_scatter(hit, roots))
        return self._hit_images(Buffers(sdf, rays, camera.cosines(), trace, self.radius))

    def _hit_images(self, buffers: Buffers) -> Images:
        hit = self.trace.hit
        images = {"distance": buffers.distance[hit], "depth": buffers.depth[hit]}
        return images | {"hit points": buffers.points, "normal": buffers.normal[hit]}


@dataclass(frozen=True)
class Footprints:
    """At most MOST_FOOTPRINTS hits of a view, with the median width of a footprint.

    A difference step moves the median hit by STEP_OF_VIEW or STEP_OF_FIELD widths to each side. A code that moves the
    surface by a whole pixel makes another shape: over such a step derivatives of the hits are off by up to 30 %.
    """

    view: Retraced
    chosen: Bool[Tensor, "height width"]
    width: float

    @staticmethod
    def of(view: Retraced, sdf: SDF, camera: Camera) -> "Footprints":
        footprints = Footprints(view, thinned(view.trace.hit, MOST_FOOTPRINTS), 0.0)
        with torch.no_grad():
            widths = footprints._buffers(sdf, camera, footprints._distance).footprint_widths
        return replace(footprints, width=float(widths.median()))

    def step(self, of_field: bool) -> float:
        """Returns how far a difference step moves the median hit."""
        return (STEP_OF_FIELD if of_field else STEP_OF_VIEW) * self.width

    def slopes(self, move: Move, step: float) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Returns derivatives of footprint normals, and central differences; NaN where a hit is lost."""

        def attached(h: Tensor) -> Images:
            buffers = self._buffers(*move(h), self._distance)
            return {"footprint normal": buffers.footprint_normal, "hit points": buffers.points}

        by_autograd = image_derivatives(attached, self._distance)
        speed = float(by_autograd["hit points"].norm(dim=-1).median())
        normals = {"footprint normal": by_autograd["footprint normal"]}  # for its shape: central differences ignore it
        h = step / speed if speed > 0 else step  # where nothing moves, any step will do
        central, _ = differences(lambda h: self._retraced(*move(h)), normals, h, self._distance)
        return normals["footprint normal"], central["footprint normal"]

    @property
    def _distance(self) -> Float[Tensor, "n"]:
        return self.view.trace.distance[self.chosen]

    def _retraced(self, sdf: SDF, camera: Camera) -> Images:
        slope = self.view.slope[self.chosen[self.view.trace.hit]]
        zero = self.view.precision.zero
        roots = root_near(sdf, camera.rays()[self.chosen], self._distance, slope, zero, FOOTPRINT_CHORDS)
        lost = roots.isnan()
        normals = self._buffers(sdf, camera, torch.where(lost, self._distance, roots)).footprint_normal
        return {"footprint normal": normals.masked_fill(lost[:, None], torch.nan)}

    def _buffers(self, sdf: SDF, camera: Camera, distance: Float[Tensor, "n"]) -> Buffers:
        trace = replace(self.view.trace[self.chosen], distance=distance)
        rays = camera.rays()[self.chosen]
        cosines = camera.cosines()[self.chosen]
        return Buffers(sdf, rays, cosines, trace, self.view.radius, pixel=camera.pixel_angle()[self.chosen])


@torch.no_grad()
def root_near(
    sdf: SDF,
    rays: Rays,
    distance: Float[Tensor, "*batch"],
    slope: Float[Tensor, "*batch"],
    precision: float,
    chords: int = CHORDS,
) -> Float[Tensor, "*batch"]:
    """Returns the root of f next to a distance by the chord method with a fixed slope; NaN without convergence."""
    last = distance
    for _ in range(chords):
        last = distance
        distance = distance - sdf(rays.at(distance)) / slope
    return distance.masked_fill(~((distance - last).abs() < precision), torch.nan)


@torch.no_grad()
def minimum_near(sdf: SDF, rays: Rays, closest: Float[Tensor, "n"], reach: float) -> Float[Tensor, "n"]:
    """Returns the least value of f next to a distance: where the lines on both sides of the minimum cross.

    A ReLU network is linear between kinks. Its minimum is that crossing, which no sample meets.
    """
    t, value = surface.minimum_and_value(sdf, rays, closest, reach=reach, refine=ROUNDS)
    w = 3 * reach / 5**ROUNDS
    left_outer, left, right, right_outer = (sdf(rays.at(t + k * w)) for k in (-2, -1, 1, 2))
    falls = (left - left_outer) / w
    rises = (right_outer - right) / w
    encloses = (falls < 0) & (rises > 0)
    offset = (left - right + (falls + rises) * w) / torch.where(encloses, rises - falls, 1.0)
    return torch.where(encloses, left + falls * (offset + w), value)


@torch.no_grad()
def _refined(sdf: SDF, camera: Camera, trace: Trace, precision: Precision) -> tuple[Trace, Float[Tensor, "hits"]]:
    """Returns the trace with its hits at roots of f, and the slopes of f there; hits without a root are EXHAUSTED."""
    hit = trace.hit
    rays = camera.rays()[hit]
    _, gradient = value_and_gradient(sdf, rays.at(trace.distance[hit]))
    slope = (gradient * rays.directions).sum(-1)
    roots = root_near(sdf, rays, trace.distance[hit], slope, precision.zero)
    lost = roots.isnan()
    outcome = trace.outcome.masked_scatter(hit, torch.where(lost, int(Outcome.EXHAUSTED), trace.outcome[hit]))
    distance = trace.distance.masked_scatter(hit, roots.masked_fill(lost, torch.inf))
    closest = trace.closest.masked_scatter(hit, torch.where(lost, trace.closest[hit], roots))
    return replace(trace, distance=distance, outcome=outcome, closest=closest), slope[~lost]
