"""Choosing pixels of an image."""

from collections.abc import Callable

import torch
from jaxtyping import Bool
from torch import Tensor


def thinned(mask: Bool[Tensor, "height width"], most: int) -> Bool[Tensor, "height width"]:
    """Returns at most `most` of the pixels of a mask, evenly spread."""
    pixels = mask.nonzero()
    chosen = pixels[:: -(-len(pixels) // most) or 1]
    return torch.zeros_like(mask).index_put((chosen[:, 0], chosen[:, 1]), mask.new_ones(()))


def rectangle_around(
    mask: Bool[Tensor, "height width"], margins: Callable[[int], tuple[int, int]]
) -> Bool[Tensor, "height width"]:
    """Returns the pixels of a rectangle about those of a mask, which has some.

    `margins` takes the mask's height, and then its width; it returns the pixels before and after.
    """
    found = torch.zeros_like(mask)
    spans: list[slice] = []
    for axis in (1, 0):
        occupied = mask.any(axis).nonzero()[:, 0]
        first, last = int(occupied[0]), int(occupied[-1])
        before, after = margins(last - first + 1)
        spans.append(slice(max(first - before, 0), last + after + 1))
    found[spans[0], spans[1]] = True
    return found
