"""Rays that are traced together."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Batch:
    """Single rays, or the middle rays of square blocks of pixels. Lengths are in radii of the sphere."""

    view: Int[Tensor, "n"]  # the image of each, and the shape in a batch of shapes
    row: Int[Tensor, "n"]  # of the block in its image …
    column: Int[Tensor, "n"]
    origins: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    footprint: Float[Tensor, "n 2"]  # the width of a pixel at the origin, and its growth per unit of distance
    t: Float[Tensor, "n"]  # so far no ray of the block meets the surface
    far: Float[Tensor, "n"]  # beyond there is no surface

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, some: Tensor) -> "Batch":
        return Batch(*(getattr(self, part.name)[some] for part in fields(self)))

    def at(self, t: Float[Tensor, "*k n"]) -> Float[Tensor, "*k n 3"]:
        return torch.addcmul(self.origins, t[..., None], self.directions)

    def pixel(self, t: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """The width of a pixel at distances."""
        start, growth = self.footprint.unbind(1)
        return torch.addcmul(start, growth, t)

    def from_(self, t: Float[Tensor, "n"]) -> "Batch":
        """The same rays, clear up to other distances."""
        return replace(self, t=t)
