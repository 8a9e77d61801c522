"""Networks of one object and nothing else: its surface, and its colours in the light it was photographed in.

After IDR (Yariv et al., NeurIPS 2020), but with the light apart from what a point has of its own. The surface's network
begins as a ball (Atzmon and Lipman, *SAL*, CVPR 2020, section 4).
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from distrace.fields.base import Counted
from distrace.reconstruction.hash_grid import GridSpecs, HashGrid

BEND = 2e-4  # of the activation: nearly a ReLU, but with second derivatives


@dataclass(frozen=True)
class SurfaceSpecs:
    """Sizes of both networks. Their weights say nothing without them."""

    width: int = 128
    layers: int = 4
    frequencies: int = 8  # of the positional encoding of points: 2⁰ … 2⁷ · π
    features: int = 32  # that the surface's network hands to the colours'
    grid: GridSpecs = GridSpecs()  # of the encoding of points for colours, as fine as pixels
    colour_width: int = 64
    colour_layers: int = 2
    light_width: int = 64
    light_frequencies: int = 2  # of the encoding of points for light: shadows and lamps nearby are smooth, too
    view_frequencies: int = 1  # of the encoding of directions: what shines is smooth
    radius: float = 0.5  # of the ball that a surface begins as

    def __post_init__(self) -> None:
        if min(self.width, self.layers, self.colour_layers) < 1 or not 0 < self.radius < 1:
            raise ValueError(f"{self} makes no network; at least one layer of one unit, and a radius within (0, 1)")


class SurfaceNetwork(nn.Module):
    """f(point) → signed distance, and what its colour depends on besides: smooth layers on encoded points."""

    strength: Tensor  # of each input

    def __init__(self, specs: SurfaceSpecs = SurfaceSpecs()) -> None:
        super().__init__()
        self.specs = specs
        entered = 3 + 6 * specs.frequencies
        widths = [entered, *[specs.width] * specs.layers]
        self.hidden = nn.ModuleList(nn.Linear(before, after) for before, after in pairwise(widths))
        self.last = nn.Linear(specs.width, 1 + specs.features)
        fading = 2.0 ** (-torch.arange(specs.frequencies) / 2)  # what is smooth is learnt first, and ripples last
        self.register_buffer("strength", torch.cat([torch.ones(3), fading.repeat(6)]), persistent=False)
        self._begin_as_ball()

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The signed distance: a field."""
        return F.linear(self._trunk(points), self.last.weight[:1], self.last.bias[:1])[..., 0]

    def features(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch n"]]:
        """The signed distance, and the features of points."""
        out = self.last(self._trunk(points))
        return out[..., 0], out[..., 1:]

    def _trunk(self, points: Tensor) -> Tensor:
        x = encoded(points, self.specs.frequencies) * self.strength
        for layer in self.hidden:
            x = squareplus(layer(x))
        return x

    @torch.no_grad()
    def _begin_as_ball(self) -> None:
        """With these weights f(x) is about |x| − radius: the encoding's waves count for nothing at first."""
        for number, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            layer.weight.normal_(0.0, math.sqrt(2 / self.specs.width))
            layer.bias.zero_()
            if not number:
                layer.weight[:, 3:] = 0.0
        self.last.weight[:1].normal_(math.sqrt(math.pi / self.specs.width), 1e-4)
        self.last.bias[:1] = -self.specs.radius


class CountedSurface(Counted):
    """The same surface, counting the points that it was asked for, with or without features."""

    def __init__(self, surface: SurfaceNetwork) -> None:
        super().__init__(surface)
        self.surface = surface

    def features(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch n"]]:
        self.evaluations += points.numel() // 3
        return self.surface.features(points)


Surface = SurfaceNetwork | CountedSurface


class ColourNetwork(nn.Module):
    """Colours from 0 to 1: what a point has of its own, in a light of normals, directions and, smoothly, places.

    With both in one network, as in IDR, few photographs are learnt by heart: each gets a texture of its own, and no
    shape is told by how textures shift from one to the next.
    """

    def __init__(self, specs: SurfaceSpecs = SurfaceSpecs()) -> None:
        super().__init__()
        self.specs = specs
        self.grid = HashGrid(specs.grid)
        own = specs.grid.levels * specs.grid.channels + 3 + specs.features
        self.own = _layers([own, *[specs.colour_width] * specs.colour_layers, 3])
        lit = 9 + 6 * (specs.view_frequencies + specs.light_frequencies)
        self.light = _layers([lit, specs.light_width, specs.light_width, 3])

    def forward(
        self,
        points: Float[Tensor, "*batch 3"],
        normals: Float[Tensor, "*batch 3"],
        directions: Float[Tensor, "*batch 3"],
        features: Float[Tensor, "*batch n"],
    ) -> Float[Tensor, "*batch 3"]:
        """Directions are those of rays, from the eye to the point."""
        own = self.own(torch.cat([self.grid(points), points, features], dim=-1))
        from_where, at = self.specs.view_frequencies, self.specs.light_frequencies
        light = self.light(torch.cat([normals, encoded(directions, from_where), encoded(points, at)], dim=-1))
        return (own + light).sigmoid()


def _layers(widths: list[int]) -> nn.Sequential:
    parts = [part for before, after in pairwise(widths) for part in (nn.Linear(before, after), nn.ReLU())]
    return nn.Sequential(*parts[:-1])


def squareplus(x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """(x + √(x² + b)) / 2 (Barron, 2021): as smooth as IDR's softplus of sharpness 100, in a third of its time."""
    return (x + (x * x + BEND).sqrt()) / 2


def encoded(x: Float[Tensor, "*batch 3"], frequencies: int) -> Float[Tensor, "*batch n"]:
    """With its sines and cosines of 2ᵏ · π (Mildenhall et al., *NeRF*, ECCV 2020, section 5.1)."""
    waves = x[..., None] * (math.pi * 2.0 ** torch.arange(frequencies, device=x.device))
    return torch.cat([x, waves.sin().flatten(-2), waves.cos().flatten(-2)], dim=-1)
