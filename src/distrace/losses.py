"""What a rendering lacks of an observed view: named terms, pure functions (Liu et al., CVPR 2020, section 3.4)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.render import Buffers


@dataclass(frozen=True)
class Weights:
    """Of the terms in the sum. Depth and normal are DIST's; mask and code: see docs/from_the_paper.md."""

    depth: float = 10.0
    normal: float = 5.0
    mask: float = 10.0
    code: float = 1e-3


def depth_loss(buffers: Buffers, observed: Float[Tensor, "*batch"]) -> Tensor:
    """Mean |depth − observed| over the rays that hit and have a depth."""
    both = buffers.mask & torch.isfinite(observed)
    return (buffers.depth[both] - observed[both]).abs().sum() / both.sum().clamp_min(1)


def normal_loss(buffers: Buffers, observed: Float[Tensor, "*batch 3"]) -> Tensor:
    """Mean 1 − n · observed over the rays that hit and have a normal.

    n are the footprint normals: exact normals of a ReLU network have no derivative that the loss could descend.
    """
    both = buffers.mask & (observed.norm(dim=-1) > 0.5)
    return (1 - (buffers.footprint_normal[both] * observed[both]).sum(-1)).sum() / both.sum().clamp_min(1)


def silhouette_loss(buffers: Buffers, is_object: Bool[Tensor, "*batch"], tolerance: float) -> tuple[Tensor, Tensor]:
    """What object rays lack to hit, and background rays to miss: the least f pushed below zero, or above `tolerance`.

    Both are means over all rays given.
    """
    clearance, hit = buffers.clearance, buffers.mask
    met = torch.isfinite(clearance)
    missing = clearance[is_object & ~hit & met].clamp_min(0)
    extra = (tolerance - clearance[~is_object & met]).clamp_min(0)
    count = max(is_object.numel(), 1)
    return missing.sum() / count, extra.sum() / count
