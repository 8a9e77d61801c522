"""Where a fit with a known placement starts: at the training shapes that contradict the observation least."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.decoder import FAR, Decoder
from distrace.fields.precision import BFloat16Decoder
from distrace.fitting.ray_sampling import drawn
from distrace.fitting.scan_residuals import ScanSample
from distrace.rays import meet_sphere

FREE = 3.0  # weight of the depth inside of points that are free, which few are, against distances of surface points
SCREENS = (16, 4, 1)  # one in so many points is compared with all codes, more of them with the quarter that is left


@dataclass(frozen=True)
class Hints:
    """Points whose signed distance is known; points that are known to be outside have the distance `inf`."""

    points: Float[Tensor, "n 3"]
    distances: Float[Tensor, "n"]

    @staticmethod
    def of(sample: ScanSample, random: torch.Generator) -> "Hints":
        """Returns the points of a sample, and one somewhere on each free ray in the unit sphere."""
        rays = sample.rays[torch.arange(sample.free)]
        bounds = meet_sphere(rays)
        far = bounds.far.minimum(sample.until[: sample.free])
        share = torch.rand(len(far), generator=random).to(far)
        free = rays.at(bounds.near + share * (far - bounds.near))[bounds.near < far]
        known = torch.zeros_like(sample.points[:, 0]) if sample.distances is None else sample.distances
        distances = torch.cat([known, known.new_full((len(free),), torch.inf)])
        order = drawn(torch.arange(len(distances)), len(distances), random)
        return Hints(torch.cat([sample.points, free])[order], distances[order])

    @torch.no_grad()
    def contradictions(
        self, decoder: Decoder | BFloat16Decoder, codes: Float[Tensor, "codes length"], step: int = 1
    ) -> Float[Tensor, "codes"]:
        """How far each shape is from the hints, in the mean; every `step`-th of them is compared."""
        points = self.points[::step]
        distances = self.distances[::step]
        values = decoder.fields(codes)(points.expand(len(codes), -1, -1)).clamp(-FAR, FAR)
        free = distances.isinf()
        off = (values - distances.clamp(-FAR, FAR)).abs()[:, ~free]
        inside = (-values[:, free]).clamp_min(0)
        return off.sum(1) / max(off.shape[1], 1) + FREE * inside.sum(1) / max(inside.shape[1], 1)


def nearest_codes(
    decoder: Decoder | BFloat16Decoder, codes: Sequence[Float[Tensor, "length"]], hints: Hints, count: int
) -> tuple[list[Float[Tensor, "length"]], int]:
    """Returns the `count` codes that contradict the hints least, best first, and the number of evaluations."""
    if not count or not len(codes):
        return [], 0
    left = torch.stack(list(codes))
    evaluations = 0
    for step in SCREENS:
        evaluations += len(left) * len(hints.points[::step])
        order = hints.contradictions(decoder, left, step).argsort(stable=True)
        left = left[order[: max(len(left) // 4, count)]]
    return list(left[:count]), evaluations
