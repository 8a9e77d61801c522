"""A multiresolution hash encoding: details that smooth networks are slow to learn.

Müller et al., *Instant neural graphics primitives with a multiresolution hash encoding*, SIGGRAPH 2022, section 3.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

PRIMES = (1, 2654435761, 805459861)  # of the hash, as in the paper
OUTPUT_SCALE = 10.0  # × the entries: each gets few gradients, and learns so much faster than a network's weights
CORNERS = torch.cartesian_prod(*[torch.arange(2)] * 3)  # of a cell


@dataclass(frozen=True)
class GridSpecs:
    """Sizes of the tables, which a checkpoint needs beside their entries."""

    levels: int = 10
    coarsest: int = 16  # cells along the cube around the unit sphere …
    finest: int = 256  # … in a geometric series: those of photographs of 300 pixels
    entries: int = 1 << 16  # of each level at most; corners of finer grids share them
    channels: int = 2  # of an entry

    def __post_init__(self) -> None:
        if min(self.levels, self.coarsest, self.channels) < 1 or self.finest < self.coarsest or self.entries < 8:
            raise ValueError(f"{self} makes no grids; at least one level, cell and channel, and 8 entries are needed")

    @property
    def cells(self) -> list[int]:
        """Along the cube, for each level."""
        growth = (self.finest / self.coarsest) ** (1 / max(self.levels - 1, 1))
        return [round(self.coarsest * growth**level) for level in range(self.levels)]


class HashGrid(nn.Module):
    """Points of [−1, 1]³ → `levels` × `channels` values, trilinear in each cell; constant beyond the cube."""

    corners: Int[Tensor, "8 3"]

    def __init__(self, specs: GridSpecs = GridSpecs()) -> None:
        super().__init__()
        self.specs = specs
        self.tables = nn.Parameter(1e-4 * torch.randn(specs.levels * specs.entries, specs.channels))
        self.register_buffer("corners", CORNERS, persistent=False)

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch values"]:
        levels = [self._interpolate(level, cells, points) for level, cells in enumerate(self.specs.cells)]
        return OUTPUT_SCALE * torch.cat(levels, dim=-1)

    def _interpolate(self, level: int, cells: int, points: Tensor) -> Tensor:
        """One level's values [*batch, channels]."""
        position = (points.clamp(-1, 1) + 1) / 2 * cells
        first = position.detach().floor().clamp_max(cells - 1)
        within = (position - first)[..., None, :]
        weight = torch.where(self.corners.bool(), within, 1 - within).prod(-1)
        entry = self._entry(first.long()[..., None, :] + self.corners, cells)
        values = F.embedding(level * self.specs.entries + entry, self.tables)
        return (weight[..., None] * values).sum(-2)

    def _entry(self, corner: Int[Tensor, "*batch 3"], cells: int) -> Int[Tensor, "*batch"]:
        """A corner's own entry where there are enough, otherwise one by the paper's hash."""
        x, y, z = corner.unbind(-1)
        if (cells + 1) ** 3 <= self.specs.entries:
            return (x * (cells + 1) + y) * (cells + 1) + z
        return (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % self.specs.entries
