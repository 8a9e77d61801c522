"""Rays, and the interval of each within the bounds of a field."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.equality import ByValue


@dataclass(frozen=True, eq=False, repr=False)
class Rays(ByValue):
    """Half lines origin + t · direction; directions have unit length, so t is a distance.

    >>> rays = Rays(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]]))
    >>> rays.at(torch.tensor([1.5]))
    tensor([[0.0000, 0.0000, 0.5000]])
    """

    origins: Float[Tensor, "*batch 3"]
    directions: Float[Tensor, "*batch 3"]

    @property
    def shape(self) -> torch.Size:
        return self.directions.shape[:-1]

    def at(self, distance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
        """Returns the points at distances along the rays."""
        return self.origins + distance[..., None] * self.directions

    def __getitem__(self, index: Tensor | tuple[Any, ...] | int) -> "Rays":
        return Rays(self.origins[index], self.directions[index])

    @staticmethod
    def cat(rays: Sequence["Rays"]) -> "Rays":
        """Returns rays one after the other, along the first axis."""
        return Rays(torch.cat([each.origins for each in rays]), torch.cat([each.directions for each in rays]))

    def to(self, device: torch.device | str) -> "Rays":
        return Rays(self.origins.to(device), self.directions.to(device))

    def flat(self) -> "Rays":
        return Rays(self.origins.reshape(-1, 3), self.directions.reshape(-1, 3))

    def detach(self) -> "Rays":
        return Rays(self.origins.detach(), self.directions.detach())


@dataclass(frozen=True, eq=False, repr=False)
class Bounds(ByValue):
    """The interval of each ray to trace; empty (near > far) where the ray misses what bounds the field."""

    near: Float[Tensor, "*batch"]
    far: Float[Tensor, "*batch"]

    @property
    def meets(self) -> Tensor:
        return self.near < self.far


def meet_sphere(rays: Rays, radius: float = 1.0) -> Bounds:
    """Returns the interval of each ray within a sphere around the origin: |o + t v| ≤ radius, t ≥ 0.

    >>> meet_sphere(Rays(torch.tensor([0.0, 0.0, 3.0]), torch.tensor([0.0, 0.0, -1.0])))
    Bounds(near=2, far=4)
    """
    towards = -(rays.origins * rays.directions).sum(-1)
    nearest = (rays.origins + towards[..., None] * rays.directions).square().sum(-1)  # no cancellation from far away
    half = (radius**2 - nearest).clamp_min(0).sqrt()
    near = (towards - half).clamp_min(0)
    far = towards + half
    misses = (nearest >= radius**2) | (far <= 0)
    return Bounds(near.masked_fill(misses, torch.inf), far.masked_fill(misses, -torch.inf))
