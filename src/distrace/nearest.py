"""Where a fit starts: at the mean shape, and at the training shapes that contradict least what was seen."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.code_residuals import Seen
from distrace.decoder import FAR, Decoder
from distrace.field import SDF
from distrace.prior import Prior

DEPTHS, SILHOUETTE = 100, 300  # rays of a view that hints are taken from
FREE = 3.0  # × counts, in the mean, what is inside and should not be: a point in the free space seldom says anything
SCREEN = 4  # one in so many hints is asked of all codes, all of one in so many codes


@dataclass(frozen=True)
class Hints:
    """Points whose signed distance is known, or of which it is known that they are outside: their distance is `inf`."""

    points: Float[Tensor, "n 3"]
    distances: Float[Tensor, "n"]

    @staticmethod
    def of(seen: Seen, random: torch.Generator) -> "Hints":
        """The depths, a point somewhere before each of them, and a point on each ray of the background."""
        rays, bounds, known = seen.rays, seen.bounds, seen.known
        share = torch.rand(len(known), generator=random).to(seen.observed)
        somewhere = bounds.near + share * (seen.observed.minimum(bounds.far) - bounds.near)
        free = bounds.meets & (seen.observed > bounds.near) & (known | ~seen.is_object)
        points = [rays[known].at(seen.observed[known]), rays[free].at(somewhere[free])]
        distances = [seen.observed.new_full((len(some),), value) for some, value in zip(points, (0.0, torch.inf))]
        return Hints(torch.cat(points), torch.cat(distances))

    @torch.no_grad()
    def contradicted(self, sdf: SDF) -> float:
        """How far, in the mean, a shape is from being as it is known to be."""
        values, free = sdf(self.points).clamp(-FAR, FAR), self.distances.isinf()
        apart = (values - self.distances.clamp(-FAR, FAR)).abs()[~free]
        inside = (-values[free]).clamp_min(0)
        return float(apart.sum() / max(len(apart), 1) + FREE * inside.sum() / max(len(inside), 1))

    def every(self, step: int) -> "Hints":
        return Hints(self.points[::step], self.distances[::step])


@dataclass(frozen=True)
class First:
    """Coordinates to start from, and what it took to find them."""

    coordinates: list[Float[Tensor, "dimensions"]]
    seconds: float
    evaluations: int


def first_of(decoder: Decoder, prior: Prior, hints: Hints, count: int, seed: int) -> First:
    """The mean's coordinates, those of the nearest training codes and, if these are too few, draws."""
    began = time.perf_counter()
    codes, evaluations = _nearest(decoder, prior.codes, hints, count - 1)
    nearest = [prior.coordinates(code) for code in codes]
    draws = [prior.start(k, seed) for k in range(len(nearest) + 1, count)]
    return First([prior.start(0, seed), *nearest, *draws], time.perf_counter() - began, evaluations)


def _nearest(decoder: Decoder, codes: Sequence[Tensor], hints: Hints, count: int) -> tuple[list[Tensor], int]:
    """The codes that contradict the hints least, and how often the field was asked for."""
    evaluations = 0
    if not count:
        return [], evaluations
    for some, kept in ((hints.every(SCREEN), max(count, len(codes) // SCREEN)), (hints, count)):
        evaluations += len(codes) * len(some.points)
        codes = sorted(codes, key=lambda code: some.contradicted(decoder.field(code)))[:kept]
    return list(codes), evaluations
