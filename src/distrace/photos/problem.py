"""The least-squares problem of a placed shape before photographs: residuals, and their Jacobian.

A surface point that one view sees is looked up in others (Liu et al., CVPR 2020, section 3.4; Lin et al., *Photometric
Mesh Optimization*, CVPR 2019). Its derivatives are exact: by the implicit function theorem the point slides along its
ray, and its projections slide with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.fields.base import Counted
from distrace.fields.decoder import Decoder
from distrace.fitting.code_jacobian import PRIOR_SCALE, derivatives
from distrace.fitting.solver import Residuals, charbonnier
from distrace.photos.stereo_pairs import GradientImage
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.surface import minimum
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace

NEARBY = 0.03  # radii: an iteration moves the surface by about as much; occluders are farther from a point
LEAST_SLOPE = 0.2  # of |∇f · v|: at grazing rays points slide farther than the linearisation holds
OUTLINE_SATURATION = 3.0  # × the outline scale: beyond it a label is wrong rather than the shape
PLACE_DEVIATIONS = (0.6, 0.6, 0.6, 0.2, 0.2, 0.2, 0.1)  # prior: rotation (radians), translation (radii), log scale
MARCH = TraceConfig(tolerance=1e-3, steps=50, least_step=2e-3)


@dataclass(frozen=True)
class ComparisonConfig:
    """How photographs are compared, the weights of the loss terms, and the scales of their residuals."""

    rays: int = 4000  # of all views
    neighbours: int = 4  # views that each is compared with
    fit_place: bool = True  # whether the placement is unknown, too
    same_light: bool = True  # otherwise colours are compared without their local mean and contrast
    colour_weight: float = 1.0
    outline_weight: float = 10.0
    code_weight: float = 0.02  # of the mean squared coordinate
    place_weight: float = 0.02  # of each number of the placement, in its deviations
    colour_scale: float = 0.08  # of colours from 0 to 1: larger differences count linearly
    margin: float = 0.005  # radii that the surface should stay away from background rays

    def __post_init__(self) -> None:
        if self.rays < 1 or self.neighbours < 1:
            given = f"{self.rays} rays and {self.neighbours} neighbours"
            raise ValueError(f"{given} were given; both must be at least 1")


@dataclass(frozen=True)
class PlacedShape:
    """The unknowns: a code's coordinates in the prior, and the shape's placement in the world."""

    w: Float[Tensor, "dimensions"]
    place: Similarity


@dataclass(frozen=True)
class TracedShape:
    """A shape, and the point of each ray where it is compared; distances are in the object's frame."""

    shape: PlacedShape
    distance: Float[Tensor, "n"]  # of the hit or, on rays with a wrong silhouette, of the least value
    hit: Bool[Tensor, "n"]
    wrong: Bool[Tensor, "n"]  # object rays that miss, and background rays that hit or come too close


@dataclass
class PhotoProblem:
    """Residuals of a shape on fixed rays, and between fixed pairs of a ray and a view; counts evaluations."""

    decoder: Decoder
    prior: Prior
    config: ComparisonConfig
    images: Sequence[GradientImage]
    rays: Rays  # in the world, of all views
    view: Int[Tensor, "n"]
    colour: Float[Tensor, "n channels"]
    label: Float[Tensor, "n"]  # the certainty of the object, up to 1, or of the background, down to −1; 0: unknown
    pairs: Int[Tensor, "pairs 2"]  # a ray, and another view in which its point is looked up
    expected_place: Similarity  # the mean of the placement's prior
    outline_scale: float = 0.02  # radii: larger outline residuals count linearly
    evaluations: int = 0

    @torch.no_grad()
    def trace(self, shape: PlacedShape, previous: TracedShape | None = None) -> TracedShape:
        """Traces all rays; those that hit `previous` start shortly before that hit."""
        rays = shape.place.rays_in_object(self.rays)
        bounds = meet_sphere(rays)
        start = bounds.near
        if previous is not None:
            start = torch.where(previous.hit, previous.distance - NEARBY, start)
        sdf = Counted(self.decoder.field(self.prior.code(shape.w)))
        trace = sphere_trace(sdf, rays, bounds, MARCH, start)
        to_centre = -(rays.origins * rays.directions).sum(-1)  # for rays that miss the unit sphere
        distance = torch.where(bounds.meets, trace.closest, to_centre)
        wrong = bounds.meets & torch.where(trace.hit, self.label < 0, self.label > 0)
        background = (bounds.meets & ~trace.hit & (self.label < 0)).nonzero()[:, 0]
        wrong[background] = sdf(rays[background].at(distance[background])) < NEARBY
        within = Bounds(bounds.near[wrong], bounds.far[wrong])
        distance[wrong] = minimum(sdf, rays[wrong], distance[wrong], within, reach=NEARBY, refine=2)
        self.evaluations += sdf.evaluations
        return TracedShape(shape, distance, trace.hit, wrong)

    def retract(self, state: TracedShape, step: Float[Tensor, "unknowns"]) -> TracedShape:
        """The state after a step of the unknowns: coordinates, and then placement."""
        shape = state.shape
        count = len(shape.w)
        place = shape.place.moved(step[count:]) if self.config.fit_place else shape.place
        return self.trace(PlacedShape(shape.w + step[:count], place), state)

    def residuals(self, state: TracedShape) -> Residuals:
        """Colour differences, field values at wrong silhouettes, and the prior's residuals, in this order."""
        rows = torch.cat([self.pairs[:, 0], state.wrong.nonzero()[:, 0]]).unique()
        points = self._linearise(state, rows)
        parts = [self._colours(state, points), self._outlines(state, points), self._prior(state)]
        return Residuals(
            torch.cat([part.values for part in parts]),
            torch.cat([part.jacobian for part in parts]),
            torch.cat([part.weights for part in parts]),
        )

    def terms(self, state: TracedShape, residuals: Residuals) -> dict[str, float]:
        """The robust loss of each kind of residual."""
        losses = residuals.weights * charbonnier(residuals.values.square())[0] / 2
        colours = 3 * len(self.pairs)
        outlines = colours + int(state.wrong.sum())
        parts = {"colour": losses[:colours], "outline": losses[colours:outlines], "code": losses[outlines:]}
        return {name: float(part.sum()) for name, part in parts.items()}

    def _linearise(self, state: TracedShape, rows: Int[Tensor, "rays"]) -> "_SurfacePoints":
        """Points on some rays, with the field's values and derivatives."""
        place = state.shape.place
        rays = self.rays[rows]
        points = place.rays_in_object(rays).at(state.distance[rows])
        values, gradient, by_code = derivatives(self.decoder, points, self.prior.code(state.shape.w))
        self.evaluations += len(values)
        by_unknowns = by_code @ self.prior.basis
        if self.config.fit_place:
            by_unknowns = torch.cat([by_unknowns, place.change(points, gradient)], dim=1)
        slope = (place.turned(gradient) * rays.directions).sum(-1)
        row_of_ray = torch.full_like(state.hit, -1, dtype=torch.int64)
        row_of_ray[rows] = torch.arange(len(rows), device=rows.device)
        return _SurfacePoints(row_of_ray, place.to_world(points), values, by_unknowns, slope, place.scale)

    def _colours(self, state: TracedShape, points: "_SurfacePoints") -> Residuals:
        """I_b(π_b(x)) − I_a, which changes by ∇I_b · dπ_b/dx · v dt as x slides along its ray: dt = −df / (∇f · v).

        A ray that misses keeps the residual of its closest point, so that losing it lowers no loss.
        """
        rays, views = self.pairs.T
        rows = points.row_of_ray[rays]
        values, along_ray = points.values.new_empty(2, len(rays), 3)
        for view in views.unique().tolist():
            in_view = (views == view).nonzero()[:, 0]
            image = self.images[view]
            pixels, by_point = image.project(points.points_world[rows[in_view]])
            colours, gradients = image.at(pixels)
            values[in_view] = colours - self.colour[rays[in_view]]
            motion = (by_point * self.rays.directions[rays[in_view], None]).sum(-1)
            along_ray[in_view] = (gradients * motion[:, None]).sum(-1)
        slope = points.slope[rows]
        slide = -points.scale / slope.clamp_max(-LEAST_SLOPE) * (state.hit[rays] & (slope < 0))
        scale = self.config.colour_scale
        jacobian = (along_ray * slide[:, None] / scale)[..., None] * points.by_unknowns[rows][:, None]
        weights = values.new_full((values.numel(),), self.config.colour_weight / max(values.numel(), 1))
        return Residuals((values / scale).flatten(), jacobian.flatten(0, 1), weights)

    def _outlines(self, state: TracedShape, points: "_SurfacePoints") -> Residuals:
        """Least values that should be negative, or above the margin.

        Pixels far on the wrong side are wrong labels and saturate: only those near the outline tell where it is.
        """
        wrong = state.wrong.nonzero()[:, 0]
        rows = points.row_of_ray[wrong]
        label = self.label[wrong]
        least = points.values[rows]
        excess = torch.where(label > 0, least.clamp_min(0), (least - self.config.margin).clamp_max(0))
        excess = excess / self.outline_scale
        shrink = 1 / (1 + (excess / OUTLINE_SATURATION).square()).sqrt()
        by_value = (shrink**3 / self.outline_scale).masked_fill(excess == 0, 0.0)
        weights = self.config.outline_weight * label.abs() / len(state.hit)
        return Residuals(excess * shrink, points.by_unknowns[rows] * by_value[:, None], weights)

    def _prior(self, state: TracedShape) -> Residuals:
        """The code's coordinates, and the placement's distance from the expected one."""
        config = self.config
        w = state.shape.w
        deviations = torch.tensor(PLACE_DEVIATIONS).to(w)
        place = state.shape.place.step_from(self.expected_place) / deviations
        by_place = (1 / deviations).diag()[:, : len(place) * config.fit_place]
        jacobian = torch.block_diag(torch.eye(len(w)).to(w), by_place)
        weights = torch.cat(
            [torch.full_like(w, config.code_weight / len(w)), torch.full_like(place, config.place_weight)]
        )
        return Residuals(PRIOR_SCALE * torch.cat([w, place]), PRIOR_SCALE * jacobian, 2 * weights / PRIOR_SCALE**2)


@dataclass(frozen=True)
class _SurfacePoints:
    """Points where rays are compared, and the field's derivatives there."""

    row_of_ray: Int[Tensor, "n"]  # −1 for rays that are not compared
    points_world: Float[Tensor, "rows 3"]
    values: Float[Tensor, "rows"]
    by_unknowns: Float[Tensor, "rows unknowns"]  # of the field in the object's frame, at a fixed point of the world
    slope: Float[Tensor, "rows"]  # ∇f · v
    scale: Float[Tensor, ""]  # of the placement
