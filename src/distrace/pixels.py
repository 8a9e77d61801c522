"""Choosing pixels of an image."""

import torch
from jaxtyping import Bool
from torch import Tensor


def thinned(mask: Bool[Tensor, "height width"], most: int) -> Bool[Tensor, "height width"]:
    """Returns at most `most` of the pixels of a mask, evenly spread."""
    pixels = mask.nonzero()
    chosen = pixels[:: -(-len(pixels) // most) or 1]
    return torch.zeros_like(mask).index_put((chosen[:, 0], chosen[:, 1]), mask.new_ones(()))
