"""How far a placed shape is from a scan: residuals of its code and its placement, and their exact Jacobian."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.data.scan import Scan
from distrace.fields.batch import BatchField
from distrace.fields.decoder import FAR, Decoder
from distrace.fields.precision import BFloat16Decoder
from distrace.fitting.code_jacobian import SMALL, derivatives
from distrace.fitting.ray_sampling import drawn
from distrace.fitting.solver import Residuals
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.rays import Rays, meet_sphere

CODE_DEVIATION = 0.7  # of a code's coordinates from those of the training shape that it starts from
GROWTH = 0.25  # standard deviation of the logarithm of the size, about the size that the start has
EFFECTIVE_POINTS = 200.0  # what all points count together, however many: errors of a shape are alike nearby
EFFECTIVE_RAYS = 600.0  # the same, of rays
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

    def code(self, prior: Prior) -> Float[Tensor, "length"]:
        return self.base + prior.basis[:, : len(self.w)] @ self.w


@dataclass(frozen=True)
class Start:
    """What is likely of the end of a start."""

    size: float
    up: Float[Tensor, "3"] | None


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
    starts: Sequence[Start]
    tilt: float
    samples: int  # on each ray, at which its least value is sought
    moves: bool = True  # whether the placement is unknown
    code_deviation: float = CODE_DEVIATION
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
        origins = torch.stack([each.origins for each in rays])
        directions = torch.stack([each.directions for each in rays])
        scale = torch.stack([state.place.scale for state in states])[:, None]
        bounds = meet_sphere(Rays(origins, directions))
        far = bounds.far.minimum((sample.until - self.deviation) / scale)
        meets = bounds.near < far
        near, far = (edge.masked_fill(~meets, 0.0) for edge in (bounds.near, far))
        width = (far - near) / self.samples
        steps = torch.arange(self.samples).to(near) + 0.5
        t = near[..., None] + width[..., None] * steps
        least, where = field(origins[:, :, None] + t[..., None] * directions[:, :, None]).min(dim=2)
        t = t.gather(2, where[..., None])[..., 0]
        refined = self._refine(field, Rays(origins, directions), t, least, width, meets)
        is_free = torch.arange(count, device=t.device) < sample.free
        wrong = meets & torch.where(is_free, least * scale < MARGIN * self.deviation, least > 0)
        at = origins + t[..., None] * directions
        for state, more in zip(states, refined, strict=True):
            self.evaluations[state.start] += count * self.samples + more
        free = (wrong & is_free).sum(1).tolist()
        return [(state.place.to_world(at[k, wrong[k]]), free[k]) for k, state in enumerate(states)]

    def _refine(
        self, field: BatchField, rays: Rays, t: Tensor, least: Tensor, width: Tensor, meets: Bool[Tensor, "starts n"]
    ) -> list[int]:
        """Looks between the samples of rays on which something may be there; moves `t` and `least`.

        Returns the evaluations of each start.
        """
        is_near = meets & (least.abs() < width)
        evaluations = (FINE_SAMPLES * is_near.sum(1)).tolist()
        start, ray = is_near.nonzero(as_tuple=True)
        if not len(start):
            return evaluations
        offsets = torch.linspace(-0.5, 0.5, FINE_SAMPLES).to(t) * (1 - 1 / FINE_SAMPLES)
        along = t[start, ray][None] + width[start, ray] * offsets[:, None]
        some = rays[start, ray]
        values, where = field.select(start)(some.origins + along[..., None] * some.directions).min(dim=0)
        better = values < least[start, ray]
        start, ray = start[better], ray[better]
        t[start, ray] = along.gather(0, where[None])[0, better]
        least[start, ray] = values[better]
        return evaluations

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
        weights = values.new_full((len(values),), EFFECTIVE_POINTS / max(len(sample.points), 1))
        weights[len(sample.points) :] = EFFECTIVE_RAYS / max(len(sample.until), 1)
        off = values * factor
        off[len(sample.points) : len(sample.points) + free] -= MARGIN
        if self.moves:
            off[: len(sample.points)] += POINT_DEPTH
        if sample.distances is not None:
            count = len(sample.points)
            off[:count] -= sample.distances.clamp(-FAR, FAR) / self.deviation
            far = (sample.distances.abs() > FAR) & (values[:count] * sample.distances.sign() > FAR)
            off[:count][far] = 0.0
            jacobian[:count][far] = 0.0
        beliefs, by_unknowns = self._beliefs(state)
        return Residuals(
            torch.cat([off, SMALL * beliefs]),
            torch.cat([jacobian, SMALL * by_unknowns]),
            torch.cat([weights, torch.full_like(beliefs, SMALL**-2)]),
        )

    def _beliefs(self, state: PlacedCode) -> tuple[Tensor, Tensor]:
        """Returns what the prior says, in standard deviations, and its derivatives by all unknowns."""
        count = len(state.w)
        w, place = state.w, state.place
        if not self.moves:
            return w / self.code_deviation, torch.eye(count).to(w) / self.code_deviation
        growth = (place.scale / self.starts[state.start].size).log()[None] / GROWTH
        tilt = w.new_zeros(0)
        by_turn = w.new_zeros(0, 3)
        up = self.starts[state.start].up
        if up is not None:
            axis = place.rotation[:, 1]
            tilt = torch.linalg.cross(axis, up) / self.tilt
            by_turn = (axis[:, None] * up[None] - (axis @ up) * torch.eye(3).to(w)) / self.tilt
        derivatives = w.new_zeros(count + 1 + len(tilt), count + 7)
        derivatives[:count, :count] = torch.eye(count) / self.code_deviation
        derivatives[count, count + 6] = 1 / GROWTH
        derivatives[count + 1 :, count : count + 3] = by_turn
        return torch.cat([w / self.code_deviation, growth, tilt]), derivatives


def extended(
    decoder: Decoder | BFloat16Decoder, points: Float[Tensor, "n 3"], code: Float[Tensor, "length"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"], Float[Tensor, "n length"]]:
    """Returns values and their derivatives; beyond the unit sphere, the value at the sphere and the distance to it.

    A decoder is not trained beyond the sphere.
    """
    length = points.norm(dim=-1, keepdim=True).clamp_min(1.0)
    within = points / length
    values, gradient, by_code = derivatives(decoder, within, code)
    beyond: Bool[Tensor, "n 1"] = length > 1
    across = (gradient - (gradient * within).sum(-1, keepdim=True) * within) / length + within
    return values + (length - 1)[:, 0], torch.where(beyond, across, gradient), by_code
