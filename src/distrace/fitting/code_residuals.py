"""What the shape of a code lacks of observed views: residuals on rays, and their exact derivatives."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.fields.base import SDF
from distrace.fields.batch import CountedBatch
from distrace.fields.decoder import Decoder
from distrace.fields.precision import BFloat16Decoder
from distrace.fitting.code_jacobian import derivatives, with_prior
from distrace.fitting.observations import Seen
from distrace.fitting.solver import Residuals
from distrace.losses import Weights
from distrace.prior import Prior
from distrace.rays import Bounds
from distrace.surface import minimum_and_value
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace

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
    trace: TraceConfig = field(default_factory=lambda: TraceConfig(tolerance=1e-3, steps=50, least_step=2e-3))


@dataclass(frozen=True)
class Look:
    """One start's code coordinates, and where along the rays their shape is compared with what was seen."""

    start: int  # its number among the starts that are fitted together
    w: Float[Tensor, "dimensions"]
    distance: Float[Tensor, "n"]
    hit: Bool[Tensor, "n"]
    compared: Bool[Tensor, "n"]
    watched: Bool[Tensor, "n"]  # compared, or near to that: what a step may change
    scale: float  # the problem's when all rays were looked along


@dataclass(frozen=True)
class _Part:
    """Some rays of each of several shapes, one after the other."""

    at: tuple[Int[Tensor, "m"], Int[Tensor, "m"]]  # shapes and rays, as an index of [shapes, rays]
    seen: Seen
    sdf: SDF

    @staticmethod
    def of(field: CountedBatch, seen: Seen, rays: Bool[Tensor, "#shapes n"]) -> "_Part":
        shape, row = rays.expand(len(field), -1).nonzero(as_tuple=True)
        return _Part((shape, row), seen[row], field.select(shape))


@dataclass
class Problem:
    """Residuals of the coordinates of several codes, each a start, on fixed rays.

    All functions take what belongs to each start, and evaluate the field for all of them together; a start's results
    do not depend on the others.
    """

    decoder: Decoder | BFloat16Decoder  # rounded where that is faster; residuals are not
    prior: Prior
    seen: Seen
    config: Comparison
    scale: float = 0.02  # up to which deviations count by their squares
    evaluations: Counter[int] = field(default_factory=Counter)  # of the field, by each start

    @torch.no_grad()
    def look(self, w: Sequence[Float[Tensor, "dimensions"]], last: Sequence[Look] | None = None) -> list[Look]:
        """Along all rays, and again if the scale is another: what ended on the surface is followed from there on.

        Of those without a depth the ones that disagree with the mask are compared, and those that touch the shape,
        where the field is least; those that are near to that are watched.
        """
        if last is not None and last[0].scale == self.scale:
            return list(last)
        field, seen, near = self._field(w), self.seen, self.seen.bounds.near.repeat(len(w), 1)
        if last is not None:
            hit, distance = torch.stack([look.hit for look in last]), torch.stack([look.distance for look in last])
            near = torch.where(hit | seen.known, distance - BACK, near)
        every = _Part.of(field, seen, torch.ones_like(near, dtype=torch.bool))
        t, hit = (image.reshape(near.shape) for image in self._met(every, near.reshape(-1)))
        free = ~seen.known & ~seen.is_object & seen.bounds.meets
        aside = _Part.of(field, seen, free & ~hit)
        values = aside.sdf(aside.seen.rays.at(t[aside.at]))
        close = free.repeat(len(w), 1)
        free = close.clone()
        free[aside.at], close[aside.at] = values < ATTENTION, values < WATCHED
        lacking = ~seen.known & seen.is_object & seen.bounds.meets & (~hit | seen.touches)
        wrong = _Part.of(field, seen, free | lacking)
        t[wrong.at], values = _lowest(wrong, t[wrong.at])
        compared = seen.known.repeat(len(w), 1)
        compared[wrong.at] = self._amiss(wrong.seen, values)
        self._count(range(len(w)), field.evaluations)
        watched = seen.known | close | lacking
        return [Look(k, w[k], t[k], hit[k], compared[k], watched[k], self.scale) for k in range(len(w))]

    @torch.no_grad()
    def moved(self, looks: Sequence[Look], steps: Sequence[Float[Tensor, "dimensions"]]) -> list[Look]:
        """Along the rays that are watched, about where they ended last; the others stay as they were."""
        w = [look.w + step for look, step in zip(looks, steps, strict=True)]
        images = zip(*((look.distance, look.hit, look.compared, look.watched) for look in looks))
        t, hit, compared, watched = (torch.stack(image) for image in images)
        field, known = self._field(w), self.seen.known
        part = _Part.of(field, self.seen, known[None])
        t[part.at], hit[part.at] = self._met(part, t[part.at] - BACK)
        part = _Part.of(field, self.seen, watched & ~known)
        t[part.at], values = _lowest(part, t[part.at], NEAR, ROUNDS_NEAR)
        hit[part.at] = values <= 0
        compared[part.at] = self._amiss(part.seen, values)
        self._count([look.start for look in looks], field.evaluations)
        return [replace(look, w=w[k], distance=t[k], hit=hit[k], compared=compared[k]) for k, look in enumerate(looks)]

    def _amiss(self, seen: Seen, least: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """Which rays without a depth disagree with the mask, or may, for their least values are rounded; or touch."""
        return seen.touches | torch.where(seen.is_object, least > 0, least < self.config.margin + ROUNDED)

    def _field(self, w: Sequence[Float[Tensor, "dimensions"]]) -> CountedBatch:
        return CountedBatch(self.decoder.fields(torch.stack([self.prior.code(each) for each in w])))

    def _count(self, starts: Sequence[int], evaluations: Sequence[int]) -> None:
        self.evaluations.update(dict(zip(starts, evaluations, strict=True)))

    def _met(self, part: _Part, near: Float[Tensor, "n"]) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
        """Where rays meet the surface, and whether they do; those with a depth are followed no farther than that."""
        seen = part.seen
        far = torch.where(seen.known, seen.observed.minimum(seen.bounds.far), seen.bounds.far)
        trace = sphere_trace(part.sdf, seen.rays, Bounds(seen.bounds.near, far), self.config.trace, near)
        return torch.where(trace.hit | ~seen.known, trace.closest, seen.observed), trace.hit

    def residuals(self, looks: Sequence[Look]) -> list[Residuals]:
        """Along rays: how far the surface is from what was seen; and, for the prior, the coordinates themselves.

        Of a depth that is the field at the observed point over |∇f · v| there or, where the surface hides that point,
        t − t_observed; of an object ray that misses, and of one that is to touch, the least value; of a ray of the
        background what that lacks to the margin. All change with the code as f does at a fixed point.
        """
        return [self._residuals(look) for look in looks]  # a start has enough rays for one product

    def _residuals(self, look: Look) -> Residuals:
        seen, t = self.seen[look.compared.nonzero()[:, 0]], look.distance[look.compared]
        values, gradient, by_code = derivatives(self.decoder, seen.rays.at(t), self.prior.code(look.w))
        self.evaluations[look.start] += len(values)
        slope, known = (gradient * seen.rays.directions).sum(-1).abs(), seen.known
        before = torch.where(known, t - seen.observed, 0.0)
        lacking = torch.where(seen.is_object, values.clamp_min(0), (values - self.config.margin).clamp_max(0))
        lacking = torch.where(seen.touches, values, lacking)
        along = torch.where(known, 1 / slope.clamp_min(GRAZING), 1.0)
        values = torch.where(known, values + before * slope, lacking) * along
        jacobian = (by_code @ self.prior.basis * along[:, None]).masked_fill((values == 0)[:, None], 0.0)
        return with_prior(values, jacobian, seen.weights / self.scale, look.w, self.config.weights.code)

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
    part: _Part, t: Float[Tensor, "n"], reach: float = REACH, rounds: int = ROUNDS
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    return minimum_and_value(part.sdf, part.seen.rays, t, part.seen.bounds, reach=reach, refine=rounds)
