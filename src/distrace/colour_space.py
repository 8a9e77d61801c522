"""Conversion between linear light and sRGB, as pictures store it (IEC 61966-2-1)."""

import torch
from jaxtyping import Float
from torch import Tensor

KNEE = (0.0031308, 0.04045)  # linear and sRGB: below, the curve is a straight line


def to_srgb(linear: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Returns linear values as pictures store them (IEC 61966-2-1); negative ones stay in proportion.

    >>> to_srgb(torch.tensor([0.0, 0.2140, 1.0])).round(decimals=3)
    tensor([0.0000, 0.5000, 1.0000])
    """
    curve = 1.055 * linear.clamp_min(KNEE[0]) ** (1 / 2.4) - 0.055
    return torch.where(linear <= KNEE[0], 12.92 * linear, curve)


def to_linear(srgb: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Returns the linear values of a picture's."""
    curve = ((srgb.clamp_min(KNEE[1]) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= KNEE[1], srgb / 12.92, curve)
