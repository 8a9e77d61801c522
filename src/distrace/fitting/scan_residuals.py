"""How far a placed shape is from a scan: residuals of its code and its placement, and their exact Jacobian."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.data.scan import Scan
from distrace.fields.base import SDF, clamped_to_ball
from distrace.fields.batch import BatchField, Selection
from distrace.fields.decoder import FAR, Decoder
from distrace.fields.precision import BFloat16Decoder
from distrace.fitting.code_jacobian import PRIOR_SCALE, derivatives
from distrace.fitting.ray_sampling import drawn
from distrace.fitting.solver import Residuals
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.rays import Rays, meet_sphere

CODE_DEVIATION = 0.7  # of a code's coordinates from those that it starts from
GROWTH = 0.25  # standard deviation of the logarithm of the size, about the size that the start has
EFFECTIVE_POINTS = 200.0  # of a scan: what all points count together, as errors of a shape are alike nearby …
EFFECTIVE_RAYS = 600.0  # … and all rays
FINE_SAMPLES = 4  # points about the least sample of a ray
MARGIN = 0.7  # deviations that a free ray keeps from the surface
POINT_DEPTH = 0.3  # deviations that points of a scan lie inside, so that a thin sheet has an inside


@dataclass(frozen=True)
class PlacedCode:
    """A code as the one it started from and what was added, and where its shape is placed in the scan's frame."""

    start: int
    base: Float[Tensor, "length"]
    w: Float[Tensor, "dimensions"]  # added, in leading coordinates of the prior
    place: Similarity

    @staticmethod
    def at(place: Similarity, base: Float[Tensor, "length"], start: int = 0) -> "PlacedCode":
        """Returns a code as it is, at a placement."""
        return PlacedCode(start, base, base[:0], place)

    def code(self, prior: Prior) -> Float[Tensor, "length"]:
        return self.base + prior.basis[:, : len(self.w)] @ self.w


@dataclass(frozen=True)
class PlacementPrior:
    """Where a start is likely to end: Gaussians of its size, its centre and its own up."""

    size: float
    centre: Float[Tensor, "3"]
    up: Float[Tensor, "3"] | None
    size_deviation: float = GROWTH  # of the logarithm
    centre_deviation: float = torch.inf  # in sizes, along each axis; `inf` without a network

    def prior_deviation(self, place: Similarity) -> float | None:
        """Returns how many deviations a placement is away, by size or centre; None without a network."""
        if math.isinf(self.centre_deviation):
            return None
        size = abs(float((place.scale / self.size).log())) / self.size_deviation
        shift = (place.translation - self.centre).square().mean().sqrt() / self.size
        return max(size, float(shift) / self.centre_deviation)


@dataclass(frozen=True)
class ScanSample:
    """Points and rays of a scan that a problem compares; the first `free` of the rays are free up to a distance."""

    points: Float[Tensor, "n 3"]
    rays: Rays
    until: Float[Tensor, "m"]
    free: int
    distances: Float[Tensor, "n"] | None = None
    """Of the points from the surface, signed; one beyond `FAR` only tells the side. None: all points are on it."""

    @staticmethod
    def drawn(scan: Scan, points: int, rays: int, random: torch.Generator) -> "ScanSample":
        """Returns at most so many points and rays, at random."""
        chosen = drawn(scan.points, points, random)
        hits = torch.randperm(len(scan.hits.origins), generator=random)[: rays // 2]
        free = torch.randperm(len(scan.free_until), generator=random)[: rays - len(hits)]
        until = torch.cat([scan.free_until[free], scan.points.new_full((len(hits),), torch.inf)])
        return ScanSample(chosen, Rays.cat([scan.free[free], scan.hits[hits]]), until, len(free))


@dataclass
class ScanProblem:
    """Residuals of several starts, in units of `deviation`.

    At points f · scale, which is how far they are from the surface; on rays the same at the least value, where that is
    negative; for the prior the code's coordinates, the tilt and the growth.
    """

    decoder: Decoder | BFloat16Decoder
    prior: Prior
    sample: ScanSample
    deviation: float  # in the scan's unit
    placement_priors: Sequence[PlacementPrior]  # of each start; none where the placement is known
    tilt: float
    samples: int  # on each ray, at which its least value is sought
    moves: bool = True  # whether the placement is unknown
    code_deviation: float = CODE_DEVIATION
    effective_points: float = EFFECTIVE_POINTS
    effective_rays: float = EFFECTIVE_RAYS
    margin: float = MARGIN
    evaluations: Counter[int] = field(default_factory=Counter)  # of the field, by each start

    def retract(self, states: Sequence[PlacedCode], steps: Sequence[Tensor]) -> list[PlacedCode]:
        """Returns states after steps; shifts are in units of the object's size."""
        moved = []
        for state, step in zip(states, steps, strict=True):
            count = len(state.w)
            place = state.place
            if self.moves:
                motion = step[count:].clone()
                motion[3:6] *= place.scale
                place = place.moved(motion)
            moved.append(replace(state, w=state.w + step[:count], place=place))
        return moved

    def residuals(self, states: Sequence[PlacedCode]) -> list[Residuals]:
        codes = torch.stack([state.code(self.prior) for state in states])
        wrong = self._wrong(self.decoder.fields(codes), states)
        return [self._residuals(*each) for each in zip(states, codes, wrong, strict=True)]

    @torch.no_grad()
    def _wrong(self, field: BatchField, states: Sequence[PlacedCode]) -> list[tuple[Tensor, int]]:
        """Returns, of each state, where rays are nearest to the inside: of free ones that enter it, and hits that miss.

        Free ones come first; their number is returned, too. They keep a margin, as thin sheets hardly have an inside.
        The points are in the scan's frame, so that they stay where they are when the state moves.
        """
        sample = self.sample
        count = len(sample.until)
        if not count:
            return [(sample.points[:0], 0)] * len(states)
        rays = [state.place.rays_in_object(sample.rays) for state in states]
        scale = torch.stack([state.place.scale for state in states])
        bounds = [meet_sphere(each) for each in rays]
        near = torch.stack([each.near for each in bounds])
        far = torch.stack([each.far for each in bounds]).minimum((sample.until - self.deviation) / scale[:, None])
        start, ray = (near < far).nonzero(as_tuple=True)
        at = torch.stack([each.origins for each in rays])[start, ray]
        direction = torch.stack([each.directions for each in rays])[start, ray]
        width = (far - near)[start, ray] / self.samples
        steps = torch.arange(self.samples).to(near)[:, None] + 0.5
        along = Rays(at, direction)
        values = field.select(start)
        t, least = _least(values, along, near[start, ray] + width * steps)
        is_near = least.abs() < width
        _refine(values, along, width, is_near.nonzero()[:, 0], t, least)
        is_free = ray < sample.free
        depth = torch.where(is_free, least, -least) * scale[start]
        wrong = torch.where(is_free, depth < self.margin * self.deviation, depth < 0)
        found = at + t[:, None] * direction
        parts = []
        for k, state in enumerate(states):
            mine = start == k
            self.evaluations[state.start] += self.samples * int(mine.sum()) + FINE_SAMPLES * int((mine & is_near).sum())
            parts.append((state.place.to_world(found[mine & wrong]), int((mine & wrong & is_free).sum())))
        return parts

    def _residuals(self, state: PlacedCode, code: Tensor, wrong: tuple[Tensor, int]) -> Residuals:
        place = state.place
        sample = self.sample
        at_rays, free = wrong
        points = place.to_object(torch.cat([sample.points, at_rays]))
        values, gradient, by_code = extended(self.decoder, points, code)
        self.evaluations[state.start] += len(values)
        factor = place.scale / self.deviation
        jacobian = by_code @ self.prior.basis[:, : len(state.w)] * factor
        if self.moves:
            by_place = place.change(points, gradient) * factor
            by_place[:, 3:6] *= place.scale
            by_place[:, 6] += values * factor  # the residual is in the scan's unit
            jacobian = torch.cat([jacobian, by_place], dim=1)
        weights = values.new_full((len(values),), self.effective_points / max(len(sample.points), 1))
        weights[len(sample.points) :] = self.effective_rays / max(len(sample.until), 1)
        off = values * factor
        off[len(sample.points) : len(sample.points) + free] -= self.margin
        if self.moves:
            off[: len(sample.points)] += POINT_DEPTH
        if sample.distances is not None:
            count = len(sample.points)
            off[:count] -= sample.distances.clamp(-FAR, FAR) / self.deviation
            far = (sample.distances.abs() > FAR) & (values[:count] * sample.distances.sign() > FAR)
            off[:count][far] = 0.0
            jacobian[:count][far] = 0.0
        placement_priors, by_unknowns = self._prior_residuals(state)
        return Residuals(
            torch.cat([off, PRIOR_SCALE * placement_priors]),
            torch.cat([jacobian, PRIOR_SCALE * by_unknowns]),
            torch.cat([weights, torch.full_like(placement_priors, PRIOR_SCALE**-2)]),
        )

    def _prior_residuals(self, state: PlacedCode) -> tuple[Tensor, Tensor]:
        """Returns what the prior says, in standard deviations, and its derivatives by all unknowns."""
        count = len(state.w)
        w, place = state.w, state.place
        if not self.moves:
            return w / self.code_deviation, torch.eye(count).to(w) / self.code_deviation
        likely = self.placement_priors[state.start]
        growth = (place.scale / likely.size).log()[None] / likely.size_deviation
        unit = likely.centre_deviation * likely.size
        shift = (place.translation - likely.centre) / unit
        tilt = w.new_zeros(0)
        by_turn = w.new_zeros(0, 3)
        if likely.up is not None:
            axis = place.rotation[:, 1]
            tilt = torch.linalg.cross(axis, likely.up) / self.tilt
            by_turn = (axis[:, None] * likely.up[None] - (axis @ likely.up) * torch.eye(3).to(w)) / self.tilt
        derivatives = w.new_zeros(count + 4 + len(tilt), count + 7)
        derivatives[:count, :count] = torch.eye(count) / self.code_deviation
        derivatives[count, count + 6] = 1 / likely.size_deviation
        derivatives[count + 1 : count + 4, count + 3 : count + 6] = torch.eye(3).to(w) * (place.scale / unit)
        derivatives[count + 4 :, count : count + 3] = by_turn
        return torch.cat([w / self.code_deviation, growth, shift, tilt]), derivatives


def extended(
    decoder: Decoder | BFloat16Decoder, points: Float[Tensor, "n 3"], code: Float[Tensor, "length"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"], Float[Tensor, "n length"]]:
    """Returns values and their derivatives by points and code, continued beyond the unit ball as `clamped_to_ball`."""
    within, beyond = clamped_to_ball(points)
    values, gradient, by_code = derivatives(decoder, within, code)
    across = (gradient - (gradient * within).sum(-1, keepdim=True) * within) / (1 + beyond[:, None]) + within
    return values + beyond, torch.where(beyond[:, None] > 0, across, gradient), by_code


def _least(field: SDF, rays: Rays, t: Float[Tensor, "samples n"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Returns where on each ray, of given distances, the field is least, and its value."""
    values, where = field(rays.origins + t[..., None] * rays.directions).min(dim=0)
    return t.gather(0, where[None])[0], values


def _refine(field: Selection, rays: Rays, width: Tensor, near: Int[Tensor, "m"], t: Tensor, least: Tensor) -> None:
    """Looks between the samples of rays `near` the surface, which are `width` apart; lowers `least` and moves `t`."""
    offsets = torch.linspace(-0.5, 0.5, FINE_SAMPLES).to(t)[:, None] * (1 - 1 / FINE_SAMPLES)
    found, values = _least(field.at_rows(near), rays[near], t[near] + width[near] * offsets)
    t[near] = torch.where(values < least[near], found, t[near])
    least[near] = values.minimum(least[near])
