"""What the shape of a code lacks of observed views: residuals on rays, and their exact derivatives."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.field import SDF, Counted
from distrace.fitting.by_code import derivatives, with_prior
from distrace.fitting.seen import Seen
from distrace.fitting.side_by_side import Fields
from distrace.fitting.solver import Residuals
from distrace.losses import Weights
from distrace.prior import Prior
from distrace.rays import Bounds
from distrace.surface import minimum_and_value
from distrace.trace import TraceConfig, sphere_trace

BACK = 0.03  # before where it ended last a ray is taken up again: what a step brings farther before is seen later
ATTENTION = 0.025  # rays of the background that come closer than this are searched for their least value …
WATCHED = 0.075  # … and those that come closer than this after each step; the others when a scale changes
REACH, ROUNDS = 0.05, 2  # to two thousandths, at first; …
NEAR, ROUNDS_NEAR = 0.02, 1  # … a step moves it little
ROUNDED = 0.005  # by more no value is off that is looked for rounded
GRAZING = 0.1  # depths on rays that meet the surface more flatly count as if they met it so


@dataclass(frozen=True)
class Comparison:
    """What deviations count: as in Adam's loss."""

    weights: Weights = Weights()
    margin: float = 0.005  # how far the surface is to stay from rays of the background
    trace: TraceConfig = field(
        default_factory=lambda: TraceConfig(coarse_levels=0, tolerance=1e-3, steps=30, least_step=2e-3)
    )


@dataclass(frozen=True)
class Look:
    """Code coordinates, and where along the rays their shape is compared with what was seen."""

    w: Float[Tensor, "dimensions"]
    distance: Float[Tensor, "n"]
    hit: Bool[Tensor, "n"]
    compared: Bool[Tensor, "n"]
    watched: Bool[Tensor, "n"]  # compared, or near to that: what a step may change
    scale: float  # the problem's when all rays were looked along


@dataclass
class Problem:
    """Residuals of a code's coordinates on fixed rays; and how often all that has asked for the field."""

    fields: Fields  # rounded where that is faster; residuals are not
    prior: Prior
    seen: Seen
    config: Comparison
    scale: float = 0.02  # up to which deviations count by their squares
    evaluations: int = 0

    @torch.no_grad()
    def look(self, w: Float[Tensor, "dimensions"], last: Look | None = None) -> Look:
        """Along all rays, and again if the scale is another: what ended on the surface is followed from there on.

        Of those without a depth the ones that disagree with the mask are compared, and those that touch the shape,
        where the field is least; those that are near to that are watched.
        """
        if last is not None and last.scale == self.scale:
            return last
        sdf, seen, near = self._field(w), self.seen, self.seen.bounds.near
        if last is not None:
            near = torch.where(last.hit | seen.known, last.distance - BACK, near)
        t, hit = self._met(sdf, seen, near)
        free = ~seen.known & ~seen.is_object & seen.bounds.meets
        aside = (free & ~hit).nonzero()[:, 0]
        values = sdf(seen.rays[aside].at(t[aside]))
        close = free.clone()
        free[aside], close[aside] = values < ATTENTION, values < WATCHED
        lacking = ~seen.known & seen.is_object & seen.bounds.meets & (~hit | seen.touches)
        wrong = free | lacking
        t[wrong], values = _lowest(sdf, seen[wrong], t[wrong])
        compared = seen.known.clone()
        compared[wrong] = self._amiss(seen[wrong], values)
        self.evaluations += sdf.evaluations
        return Look(w, t, hit, compared, seen.known | close | lacking, self.scale)

    @torch.no_grad()
    def moved(self, look: Look, step: Float[Tensor, "dimensions"]) -> Look:
        """Along the rays that are watched, about where they ended last; the others stay as they were."""
        w, (t, hit, compared) = look.w + step, (image.clone() for image in (look.distance, look.hit, look.compared))
        sdf = self._field(w)
        rows = self.seen.known.nonzero()[:, 0]
        t[rows], hit[rows] = self._met(sdf, self.seen[rows], t[rows] - BACK)
        rows = (look.watched & ~self.seen.known).nonzero()[:, 0]
        seen = self.seen[rows]
        t[rows], values = _lowest(sdf, seen, t[rows], NEAR, ROUNDS_NEAR)
        hit[rows] = values <= 0
        compared[rows] = self._amiss(seen, values)
        self.evaluations += sdf.evaluations
        return Look(w, t, hit, compared, look.watched, look.scale)

    def _amiss(self, seen: Seen, least: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """Which rays without a depth disagree with the mask, or may, for their least values are rounded; or touch."""
        return seen.touches | torch.where(seen.is_object, least > 0, least < self.config.margin + ROUNDED)

    def _field(self, w: Float[Tensor, "dimensions"]) -> Counted:
        return Counted(self.fields.field(self.prior.code(w)))

    def _met(self, sdf: Counted, seen: Seen, near: Float[Tensor, "n"]) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
        """Where rays meet the surface, and whether they do; those with a depth are followed no farther than that."""
        far = torch.where(seen.known, seen.observed.minimum(seen.bounds.far), seen.bounds.far)
        trace = sphere_trace(sdf, seen.rays, Bounds(seen.bounds.near, far), self.config.trace, near)
        return torch.where(trace.hit | ~seen.known, trace.closest, seen.observed), trace.hit

    def residuals(self, look: Look) -> Residuals:
        """Along rays: how far the surface is from what was seen; and, for the prior, the coordinates themselves.

        Of a depth that is the field at the observed point over |∇f · v| there or, where the surface hides that point,
        t − t_observed; of an object ray that misses, and of one that is to touch, the least value; of a ray of the
        background what that lacks to the margin. All change with the code as f does at a fixed point.
        """
        seen, rows = self.seen, look.compared.nonzero()[:, 0]
        rays, t = seen.rays[rows], look.distance[rows]
        values, gradient, by_code = derivatives(self.fields.quick, rays.at(t), self.prior.code(look.w))
        self.evaluations += len(values)
        slope, known = (gradient * rays.directions).sum(-1).abs(), seen.known[rows]
        before = torch.where(known, t - seen.observed[rows], 0.0)
        lacking = torch.where(seen.is_object[rows], values.clamp_min(0), (values - self.config.margin).clamp_max(0))
        lacking = torch.where(seen.touches[rows], values, lacking)
        along = torch.where(known, 1 / slope.clamp_min(GRAZING), 1.0)
        values = torch.where(known, values + before * slope, lacking) * along
        jacobian = (by_code @ self.prior.basis * along[:, None]).masked_fill((values == 0)[:, None], 0.0)
        weights = seen.weights[rows] / self.scale
        return with_prior(values, jacobian, weights, look.w, self.config.weights.code)

    def terms(self, look: Look, residuals: Residuals) -> dict[str, float]:
        """The parts of Adam's loss, its depths measured from the surface: what of all scales can be compared."""
        rows = look.compared.nonzero()[:, 0]
        known, is_object, touches = (image[rows] for image in (self.seen.known, self.seen.is_object, self.seen.touches))
        lacking = residuals.values[: len(rows)].abs() * self.seen.weights[rows]
        kinds = {"depth": known, "missing": ~known & is_object & ~touches, "extra": ~known & ~is_object}
        kinds |= {"outline": touches} if touches.any() else {}
        code = self.config.weights.code * look.w.square().mean()
        return {name: float(lacking[kind].sum()) for name, kind in kinds.items()} | {"code": float(code)}


def _lowest(
    sdf: SDF, seen: Seen, t: Float[Tensor, "n"], reach: float = REACH, rounds: int = ROUNDS
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    return minimum_and_value(sdf, seen.rays, t, seen.bounds, reach=reach, refine=rounds)
