"""Pixels and those beside them, in a batch of images that is kept flat."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Num
from torch import Tensor

SIDES = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x]


def thinned(mask: Bool[Tensor, "height width"], most: int) -> Bool[Tensor, "height width"]:
    """At most so many of the pixels of a mask, evenly spread."""
    pixels = mask.nonzero()
    kept = pixels[:: -(-len(pixels) // most) or 1]
    return torch.zeros_like(mask).index_put((kept[:, 0], kept[:, 1]), mask.new_ones(()))


@dataclass(frozen=True)
class Grid:
    """Images of [*batch, height, width] pixels."""

    shape: torch.Size

    def between(self, stride: int, coarsest: bool, device: torch.device) -> Int[Tensor, "n"]:
        """The pixels on a grid of `stride` that are not on the next coarser one."""
        height, width = self.shape[-2:]
        chosen = torch.zeros(self.shape, dtype=torch.bool, device=device)
        chosen[..., 0:height:stride, 0:width:stride] = True
        if not coarsest:
            chosen[..., 0 : height : 2 * stride, 0 : width : 2 * stride] = False
        return chosen.reshape(-1).nonzero()[:, 0]

    def parents(self, pixels: Int[Tensor, "n"], stride: int) -> tuple[Int[Tensor, "n 4"], Float[Tensor, "n 4"]]:
        """The pixels of the next coarser grid around each pixel, and their bilinear weights."""
        height, width = self.shape[-2:]
        coarse = 2 * stride
        y, x = pixels // width % height, pixels % width
        up, left = y % coarse, x % coarse
        first = pixels - up * width - left
        down = torch.where(y - up + coarse < height, coarse, 0) * width
        right = torch.where(x - left + coarse < width, coarse, 0)
        indices = torch.stack([first, first + right, first + down, first + down + right], dim=1)
        lower, later = up / coarse, left / coarse
        weights = [(1 - lower) * (1 - later), (1 - lower) * later, lower * (1 - later), lower * later]
        return indices, torch.stack(weights, dim=1)

    def behind(self, pixels: Int[Tensor, "n"], parents: Int[Tensor, "n 4"]) -> Int[Tensor, "n 4"]:
        """From each pixel through each parent, and twice as far again: -1 beyond the image."""
        height, width = self.shape[-2:]
        y, x = (pixels // width % height)[:, None], (pixels % width)[:, None]
        down, right = parents // width % height - y, parents % width - x
        row, column = y + 3 * down, x + 3 * right
        within = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        return torch.where(within, pixels[:, None] + 3 * (down * width + right), -1)

    def beside(self, pixels: Int[Tensor, "n"], values: Tensor, fill: float, reach: int = 1) -> Num[Tensor, "8 n"]:
        """The values of each pixel's eight neighbours at `reach`, in the order of SIDES; `fill` beyond the image."""
        height, width = self.shape[-2:]
        y, x = pixels // width % height, pixels % width
        found = []
        for down, right in SIDES:
            row, column = y + reach * down, x + reach * right
            within = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            index = torch.where(within, pixels + reach * (down * width + right), pixels)
            found.append(values[index].masked_fill(~within, fill))
        return torch.stack(found)

    def around(self, pixels: Int[Tensor, "n"]) -> Int[Tensor, "m"]:
        """Some pixels and their neighbours, each once."""
        index = torch.arange(self.shape.numel(), device=pixels.device)
        sides = self.beside(pixels, index, -1)
        return torch.cat([pixels, sides[sides >= 0]]).unique()

    def bend(self, pixels: Int[Tensor, "n"], values: Tensor) -> Float[Tensor, "n"]:
        """How far each value is from the mean of two opposite neighbours, in the direction where that is least."""
        beside = self.beside(pixels, values, torch.inf)
        means = (beside[:4] + beside[4:].flip(0)) / 2
        return (values[pixels] - means).abs().nan_to_num(torch.inf).amin(0)
