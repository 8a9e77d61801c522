"""Choosing pixels of an image."""

import torch
from jaxtyping import Bool
from torch import Tensor


def thinned(mask: Bool[Tensor, "height width"], most: int) -> Bool[Tensor, "height width"]:
    """At most so many of the pixels of a mask, evenly spread."""
    pixels = mask.nonzero()
    kept = pixels[:: -(-len(pixels) // most) or 1]
    return torch.zeros_like(mask).index_put((kept[:, 0], kept[:, 1]), mask.new_ones(()))
