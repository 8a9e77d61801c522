"""What a shape before several photographs lacks: colours that do not agree, and pixels it should or should not cover.

A point of the surface that one view sees is looked up in others (Liu et al., CVPR 2020, section 3.4; Lin et al.,
*Photometric Mesh Optimization*, CVPR 2019). Its derivatives are exact: by the implicit function theorem the point
slides along its ray, and with it its place in the other images.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.fields.base import Counted
from distrace.fields.decoder import Decoder
from distrace.fitting.code_jacobian import SMALL, derivatives
from distrace.fitting.solver import Residuals, charbonnier
from distrace.photos.stereo_pairs import Colours
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.surface import minimum
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace

BACK = 0.05  # before where it ended last a ray is taken up again
ATTENTION = 0.03  # rays of the background that come closer than this are searched for their least value
GRAZING = 0.2  # points that are seen more flatly slide as if they were seen so
SATURATED = 3.0  # scales: outlines that are off by more hardly pull
REACH, ROUNDS = 0.05, 2  # of the search for the least value
PLACE_DEVIATIONS = (0.6, 0.6, 0.6, 0.2, 0.2, 0.2, 0.1)  # of turn, shift, and growth: radians, radii, logarithm
PLACE = len(PLACE_DEVIATIONS)
MARCH = TraceConfig(tolerance=1e-3, steps=50, least_step=2e-3)


@dataclass(frozen=True)
class PhotoWeights:
    """Of the terms, and what deviations count by their squares."""

    colour: float = 1.0
    outline: float = 10.0
    code: float = 0.02  # of all of its coordinates
    place: float = 0.02  # of each number of it, in its deviations
    colour_scale: float = 0.08  # of colours from 0 to 1
    margin: float = 0.005  # how far the surface is to stay from rays of the background


@dataclass(frozen=True)
class Sightings:
    """Rays of all views, in the world, and what they saw."""

    rays: Rays
    view: Int[Tensor, "n"]
    colour: Float[Tensor, "n channels"]
    certainty: Float[Tensor, "n"]  # that it is the object, 1, or the background, -1; 0 where nothing tells

    def __getitem__(self, rows: Tensor) -> "Sightings":
        return Sightings(self.rays[rows], self.view[rows], self.colour[rows], self.certainty[rows])


@dataclass(frozen=True)
class Shape:
    """The unknowns: a code's coordinates, and where the shape lies in the world."""

    w: Float[Tensor, "dimensions"]
    place: Similarity


@dataclass(frozen=True)
class Look:
    """A shape, and where rays are compared with it; distances are in the object's frame."""

    shape: Shape
    distance: Float[Tensor, "n"]  # of the hit or, on rays that are wrong, of the least value
    hit: Bool[Tensor, "n"]
    wrong: Bool[Tensor, "n"]  # should hit and do not, or should not and come too close


@dataclass
class PhotoProblem:
    """Residuals of a shape on fixed rays, and between fixed pairs of a ray and a view; and the evaluations so far."""

    decoder: Decoder
    prior: Prior
    seen: Sightings
    pictures: Sequence[Colours]
    pairs: Int[Tensor, "pairs 2"]  # a ray, and another view in which its point is looked up
    weights: PhotoWeights
    moves: bool  # whether the shape's place is unknown, too
    expected: Similarity  # about which the place is thought to be
    scale: float = 0.02  # up to which misplaced outlines count by their squares
    evaluations: int = 0

    @torch.no_grad()
    def look(self, shape: Shape, last: Look | None = None) -> Look:
        """Along all rays; those that ended on the surface last are followed from shortly before."""
        rays, sure = shape.place.rays_in_object(self.seen.rays), self.seen.certainty
        bounds = meet_sphere(rays)
        start = bounds.near if last is None else torch.where(last.hit, last.distance - BACK, bounds.near)
        sdf = Counted(self.decoder.field(self.prior.code(shape.w)))
        trace = sphere_trace(sdf, rays, bounds, MARCH, start)
        nearest = -(rays.origins * rays.directions).sum(-1)  # to the middle, of rays that do not meet the sphere
        t, hit = torch.where(bounds.meets, trace.closest, nearest), trace.hit
        wrong = bounds.meets & torch.where(hit, sure < 0, sure > 0)
        aside = (bounds.meets & ~hit & (sure < 0)).nonzero()[:, 0]
        wrong[aside] = sdf(rays[aside].at(t[aside])) < ATTENTION
        some = Bounds(bounds.near[wrong], bounds.far[wrong])
        t[wrong] = minimum(sdf, rays[wrong], t[wrong], some, reach=REACH, refine=ROUNDS)
        self.evaluations += sdf.evaluations
        return Look(shape, t, hit, wrong)

    def moved(self, look: Look, step: Float[Tensor, "unknowns"]) -> Look:
        count = len(look.shape.w)
        place = look.shape.place.moved(step[count:]) if self.moves else look.shape.place
        return self.look(Shape(look.shape.w + step[:count], place), look)

    def residuals(self, look: Look) -> Residuals:
        """Differences of colour, values of the field where outlines are wrong, and the coordinates for the prior."""
        here = self._here(look, torch.cat([self.pairs[:, 0].unique(), look.wrong.nonzero()[:, 0]]).unique())
        parts = [self._colours(look, here), self._outlines(look, here), self._prior(look)]
        return Residuals(*(torch.cat(part) for part in zip(*((p.values, p.jacobian, p.weights) for p in parts))))

    def terms(self, look: Look, residuals: Residuals) -> dict[str, float]:
        """The robust loss of each kind of residual."""
        colours, outlines = 3 * len(self.pairs), int(look.wrong.sum())
        sizes = [colours, outlines, len(residuals.values) - colours - outlines]
        ends = torch.tensor([0, *sizes]).cumsum(0)
        names = ("colour", "outline", "code")
        parts = [Residuals(*(x[a:b] for x in vars(residuals).values())) for a, b in pairwise(ends)]
        return {name: part.loss(1.0, charbonnier) for name, part in zip(names, parts, strict=True)}

    def _here(self, look: Look, rows: Int[Tensor, "rays"]) -> "_Here":
        place, rays = look.shape.place, self.seen.rays[rows]
        points = place.rays_in_object(rays).at(look.distance[rows])
        values, gradient, by_code = derivatives(self.decoder, points, self.prior.code(look.shape.w))
        self.evaluations += len(values)
        changes = by_code @ self.prior.basis
        if self.moves:
            changes = torch.cat([changes, place.change(points, gradient)], dim=1)
        slope = (place.turned(gradient) * rays.directions).sum(-1)
        at = torch.full_like(look.hit, -1, dtype=torch.int64)
        at[rows] = torch.arange(len(rows), device=rows.device)
        return _Here(at, place.to_world(points), values, changes, slope, place.scale)

    def _colours(self, look: Look, here: "_Here") -> Residuals:
        """I_b(π_b(x)) − I_a, which changes by ∇I_b · dπ_b/dx · v dt as x slides along its ray: dt = −df / (∇f · v).

        A ray that misses keeps the residual of where it comes closest, so that losing it is no gain.
        """
        rays, views = self.pairs.T
        rows = here.at[rays]
        values, along = here.values.new_empty(2, len(rays), 3)
        for view in views.unique().tolist():
            some = (views == view).nonzero()[:, 0]
            picture, points = self.pictures[view], here.points[rows[some]]
            pixels, by_point = picture.projected(points)
            colours, slopes = picture.at(pixels)
            values[some] = colours - self.seen.colour[rays[some]]
            motion = (by_point * self.seen.rays.directions[rays[some], None]).sum(-1)
            along[some] = (slopes * motion[:, None]).sum(-1)
        slope = here.slope[rows]
        slide = -here.scale / slope.clamp_max(-GRAZING) * (look.hit[rays] & (slope < 0))
        scale = self.weights.colour_scale
        jacobian = (along * slide[:, None] / scale)[..., None] * here.changes[rows][:, None]
        weights = values.new_full((values.numel(),), self.weights.colour / max(values.numel(), 1))
        return Residuals((values / scale).flatten(), jacobian.flatten(0, 1), weights)

    def _outlines(self, look: Look, here: "_Here") -> Residuals:
        """Least values that should be negative, or above the margin. Pixels far on the wrong side are wrongly labelled
        ones, and pull no more: only those about the outline tell where it is."""
        wrong = look.wrong.nonzero()[:, 0]
        rows, sure = here.at[wrong], self.seen.certainty[wrong]
        least = here.values[rows]
        off = torch.where(sure > 0, least.clamp_min(0), (least - self.weights.margin).clamp_max(0)) / self.scale
        shrunk = 1 / (1 + (off / SATURATED).square()).sqrt()
        jacobian = here.changes[rows] * (shrunk**3 / self.scale).masked_fill(off == 0, 0.0)[:, None]
        return Residuals(off * shrunk, jacobian, self.weights.outline * sure.abs() / len(look.hit))

    def _prior(self, look: Look) -> Residuals:
        """The code's coordinates, and how far the place is from where it is thought to be."""
        w, deviations = look.shape.w, torch.tensor(PLACE_DEVIATIONS).to(look.shape.w)
        place = look.shape.place.step_from(self.expected) / deviations
        jacobian = torch.block_diag(torch.eye(len(w)).to(w), (1 / deviations).diag()[:, : PLACE * self.moves])
        share = torch.cat([w.new_full((len(w),), self.weights.code / len(w)), w.new_full((PLACE,), self.weights.place)])
        return Residuals(SMALL * torch.cat([w, place]), SMALL * jacobian, 2 * share / SMALL**2)


@dataclass(frozen=True)
class _Here:
    """Points where rays are compared, and how the field changes there with the unknowns."""

    at: Int[Tensor, "n"]  # the row of each ray below
    points: Float[Tensor, "rows 3"]  # in the world
    values: Float[Tensor, "rows"]
    changes: Float[Tensor, "rows unknowns"]  # of the field in the object's frame, at a fixed point of the world
    slope: Float[Tensor, "rows"]  # of the field along the ray
    scale: Float[Tensor, ""]
