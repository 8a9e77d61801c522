"""The networks of one object: its surface, and its colours in the light of the photographs.

After IDR (Yariv et al., NeurIPS 2020), but with the light apart from a point's own colour. The surface network starts
as a ball (Atzmon and Lipman, *SAL*, CVPR 2020, section 4). A hash encoding gives colours details that smooth networks
are slow to learn (Müller et al., *Instant neural graphics primitives*, SIGGRAPH 2022, section 3).
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

BEND = 2e-4  # of the activation: nearly a ReLU, but with second derivatives
PRIMES = (1, 2654435761, 805459861)  # of the hash, as Müller et al. have them
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
        """A corner's own entry where there are enough, otherwise one by the hash."""
        x, y, z = corner.unbind(-1)
        if (cells + 1) ** 3 <= self.specs.entries:
            return (x * (cells + 1) + y) * (cells + 1) + z
        return (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % self.specs.entries


@dataclass(frozen=True)
class SurfaceSpecs:
    """Sizes of both networks, which a checkpoint needs beside their weights."""

    width: int = 128
    layers: int = 4
    frequencies: int = 8  # of the positional encoding of points: 2⁰ … 2⁷ · π
    features: int = 32  # that the surface network hands to the colour network
    grid: GridSpecs = GridSpecs()  # the encoding of points for colours, as fine as pixels
    colour_width: int = 64
    colour_layers: int = 2
    light_width: int = 64
    light_frequencies: int = 2  # of the encoding of points for light: shadows and near lamps are smooth
    view_frequencies: int = 1  # of the encoding of directions: highlights are smooth
    radius: float = 0.5  # of the initial ball

    def __post_init__(self) -> None:
        if min(self.width, self.layers, self.colour_layers) < 1 or not 0 < self.radius < 1:
            raise ValueError(f"{self} makes no network; at least one layer of one unit, and a radius within (0, 1)")


class SurfaceNetwork(nn.Module):
    """Points → signed distances, and features for the colour network: smooth layers on encoded points."""

    input_scale: Tensor  # of each encoded coordinate
    evaluations: int = 0  # points that it was evaluated at

    def __init__(self, specs: SurfaceSpecs = SurfaceSpecs()) -> None:
        super().__init__()
        self.specs = specs
        widths = [3 + 6 * specs.frequencies, *[specs.width] * specs.layers]
        self.hidden = nn.ModuleList(nn.Linear(before, after) for before, after in pairwise(widths))
        self.last = nn.Linear(specs.width, 1 + specs.features)
        fading = 2.0 ** (-torch.arange(specs.frequencies) / 2)  # the surface ripples if high frequencies are as strong
        self.register_buffer("input_scale", torch.cat([torch.ones(3), fading.repeat(6)]), persistent=False)
        self._initialise_as_ball()

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Signed distances."""
        return F.linear(self._trunk(points), self.last.weight[:1], self.last.bias[:1])[..., 0]

    def features(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch n"]]:
        """Signed distances and features."""
        out = self.last(self._trunk(points))
        return out[..., 0], out[..., 1:]

    def _trunk(self, points: Tensor) -> Tensor:
        self.evaluations += points.numel() // 3
        x = encoded(points, self.specs.frequencies) * self.input_scale
        for layer in self.hidden:
            x = squareplus(layer(x))
        return x

    @torch.no_grad()
    def _initialise_as_ball(self) -> None:
        """With these weights f(x) is about |x| − radius; the encoding's waves have weight zero."""
        for number, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            layer.weight.normal_(0.0, math.sqrt(2 / self.specs.width))
            layer.bias.zero_()
            if not number:
                layer.weight[:, 3:] = 0.0
        self.last.weight[:1].normal_(math.sqrt(math.pi / self.specs.width), 1e-4)
        self.last.bias[:1] = -self.specs.radius


class ColourNetwork(nn.Module):
    """Colours from 0 to 1: a point's own colour, in a light of normals, directions and, smoothly, positions.

    One network for both, as in IDR, overfits to few photographs: each gets a texture of its own, and the shift of
    textures between photographs no longer tells the shape.
    """

    def __init__(self, specs: SurfaceSpecs = SurfaceSpecs()) -> None:
        super().__init__()
        self.specs = specs
        self.grid = HashGrid(specs.grid)
        inputs = specs.grid.levels * specs.grid.channels + 3 + specs.features
        self.own = _layers([inputs, *[specs.colour_width] * specs.colour_layers, 3])
        inputs = 9 + 6 * (specs.view_frequencies + specs.light_frequencies)
        self.light = _layers([inputs, specs.light_width, specs.light_width, 3])

    def forward(
        self,
        points: Float[Tensor, "*batch 3"],
        normals: Float[Tensor, "*batch 3"],
        directions: Float[Tensor, "*batch 3"],
        features: Float[Tensor, "*batch n"],
    ) -> Float[Tensor, "*batch 3"]:
        """Colours of points of the surface; `directions` are those of rays, from the eye to the point."""
        own = self.own(torch.cat([self.grid(points), points, features], dim=-1))
        view = encoded(directions, self.specs.view_frequencies)
        light = self.light(torch.cat([normals, view, encoded(points, self.specs.light_frequencies)], dim=-1))
        return (own + light).sigmoid()


def _layers(widths: list[int]) -> nn.Sequential:
    parts = [part for before, after in pairwise(widths) for part in (nn.Linear(before, after), nn.ReLU())]
    return nn.Sequential(*parts[:-1])


def squareplus(x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """(x + √(x² + b)) / 2 (Barron, 2021): as smooth as IDR's softplus of sharpness 100, in a third of its time."""
    return (x + (x * x + BEND).sqrt()) / 2


def encoded(x: Float[Tensor, "*batch 3"], frequencies: int) -> Float[Tensor, "*batch n"]:
    """x with its sines and cosines of 2ᵏ · π (Mildenhall et al., *NeRF*, ECCV 2020, section 5.1)."""
    waves = x[..., None] * (math.pi * 2.0 ** torch.arange(frequencies, device=x.device))
    return torch.cat([x, waves.sin().flatten(-2), waves.cos().flatten(-2)], dim=-1)
