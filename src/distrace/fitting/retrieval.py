"""Where a fit starts: at the mean shape, and at the training shapes that contradict least what was seen."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.decoder import FAR, Decoder
from distrace.fields.precision import BFloat16Decoder
from distrace.fitting.observations import Seen
from distrace.prior import Prior

DEPTHS, SILHOUETTE = 100, 300  # rays of a view that hints are taken from
FREE = 3.0  # × counts, in the mean, what is inside and should not be: a point in the free space seldom says anything
SCREENS = (16, 4, 1)  # one in so many hints is asked of all codes, more of those that are left, …
KEPT = 4  # … one in so many, and at last all
AT_ONCE = 8192  # points, of several codes


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

    @property
    def depths(self) -> int:
        """Points of the surface."""
        return int((self.distances == 0).sum())

    @torch.no_grad()
    def contradicted(
        self, decoder: Decoder | BFloat16Decoder, codes: Float[Tensor, "codes length"]
    ) -> Float[Tensor, "codes"]:
        """How far, in the mean, each shape is from being as it is known to be."""
        free, together = self.distances.isinf(), max(AT_ONCE // max(len(self.points), 1), 1)
        parts = [decoder(self.points.expand(len(some), -1, -1), some[:, None]) for some in codes.split(together)]
        values = torch.cat(parts).clamp(-FAR, FAR)
        apart = (values - self.distances.clamp(-FAR, FAR)).abs()[:, ~free]
        inside = (-values[:, free]).clamp_min(0)
        return apart.sum(1) / max(apart.shape[1], 1) + FREE * inside.sum(1) / max(inside.shape[1], 1)

    def every(self, step: int) -> "Hints":
        return Hints(self.points[::step], self.distances[::step])


@dataclass(frozen=True)
class First:
    """Coordinates to start from, and what it took to find them."""

    coordinates: list[Float[Tensor, "dimensions"]]
    seconds: float
    evaluations: int


def first_of(decoder: Decoder | BFloat16Decoder, prior: Prior, hints: Hints, count: int, seed: int) -> First:
    """The mean's coordinates, those of the nearest training codes and, if these are too few, draws."""
    began = time.perf_counter()
    codes, evaluations = _nearest(decoder, prior.codes, hints, count - 1)
    nearest = [prior.coordinates(code) for code in codes]
    draws = [prior.start(k, seed) for k in range(len(nearest) + 1, count)]
    return First([prior.start(0, seed), *nearest, *draws], time.perf_counter() - began, evaluations)


def _nearest(
    decoder: Decoder | BFloat16Decoder, codes: Sequence[Tensor], hints: Hints, count: int
) -> tuple[list[Tensor], int]:
    """The codes that contradict the hints least, and how often the field was asked for."""
    left, evaluations = torch.stack(list(codes)) if codes else torch.empty(0), 0
    if not count or not len(left):
        return [], evaluations
    for step in SCREENS:
        some = hints.every(step)
        evaluations += len(left) * len(some.points)
        order = some.contradicted(decoder, left).argsort(stable=True)
        left = left[order[: max(len(left) // KEPT, count)]]
    return list(left[:count]), evaluations
