"""Where rays of photographs are known to end: before that nothing is, and there the surface.

Depths that a view's neighbours tell (`sweep.py`) say more than outlines can: what a court or a hollow is like.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.photos.plane_sweep import Depths
from distrace.rays import Rays, meet_sphere

CONFIRMED = 2  # other views see something at a place, and fewer see through it
CLOSE = 0.02  # radii: about how far depths that are confirmed may be wrong
EXACT = CLOSE / 4  # radii: nearer to the surface than that is on it, and as far outside of it is free


@dataclass(frozen=True)
class AgreedDepths:
    """Rays that meet the unit sphere, and distances along them: of the sphere, and of the surface."""

    rays: Rays
    near: Float[Tensor, "n"]
    distance: Float[Tensor, "n"]

    @staticmethod
    @torch.no_grad()
    def of(told: Sequence[Depths]) -> "AgreedDepths":
        """Those that views agree on."""
        parts = [_confirmed(one, [other for other in told if other is not one]) for one in told]
        if not parts:
            return NO_DEPTHS
        origins, directions, near, distance = (torch.cat(part) for part in zip(*parts, strict=True))
        return AgreedDepths(Rays(origins, directions), near, distance)

    def __len__(self) -> int:
        return len(self.distance)

    def drawn(self, count: int, random: torch.Generator) -> Float[Tensor, "four_times_count 3"]:
        """Points of so many rays, in this order: on the surface, anywhere before, closely before, and behind it."""
        some = torch.randint(len(self), (count,), generator=random)
        rays, near, surface = self.rays[some], self.near[some], self.distance[some]
        anywhere, close = torch.rand(2, count, generator=random)
        before = near + anywhere * (surface - CLOSE - near).clamp_min(0)
        places = (surface, before, surface - CLOSE * (1 + 2 * close), surface + CLOSE)
        return torch.cat([rays.at(place) for place in places])


NO_DEPTHS = AgreedDepths(Rays(torch.zeros(0, 3), torch.zeros(0, 3)), torch.zeros(0), torch.zeros(0))


def contradicted(values: Float[Tensor, "four_times_count"]) -> Float[Tensor, ""]:
    """By how much a field's values at the points that `AgreedDepths.drawn` gives are wrong, in the mean."""
    on, before, close, behind = values.chunk(4)
    free = (EXACT - before).relu() + (EXACT - close).relu()
    return ((on.abs() - EXACT).relu() + free + behind.relu()).mean()


def _confirmed(one: Depths, others: Sequence[Depths]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Origins and directions of its rays, where they enter the unit sphere, and the surface."""
    rays, distance = one.camera.rays()[one.sure], (one.depth / one.camera.cosines())[one.sure]
    points, bounds = rays.at(distance), meet_sphere(rays)
    through, there = torch.zeros(2, len(points))
    for other in others:
        free, filled = other.votes(points)
        through += free
        there += filled
    kept = (there >= CONFIRMED) & (there > through) & (points.norm(dim=-1) < 1) & bounds.meets
    return rays.origins[kept], rays.directions[kept], bounds.near[kept], distance[kept]
