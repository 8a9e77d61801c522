"""Differences between a rendering and an observed view, as losses (Liu et al., CVPR 2020, section 3.4).

All are scalars, in the units of the world, and keep the gradients of the buffers.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.render import Buffers


@dataclass(frozen=True)
class Weights:
    """The weights of the terms in a sum. Depth and normal are DIST's; mask and code: see docs/from_the_paper.md."""

    depth: float = 10.0
    normal: float = 5.0
    mask: float = 10.0
    code: float = 1e-3


def depth_loss(buffers: Buffers, observed: Float[Tensor, "*batch"]) -> Tensor:
    """Returns the mean |depth − observed| over the rays that hit and have a finite observed depth.

    >>> from distrace.camera import Camera
    >>> from distrace.fields import primitives
    >>> from distrace.render import render
    >>> camera = Camera.orbit(0, 0, 4, height=16, width=16)
    >>> observed = render(primitives.sphere(0.5), camera).depth
    >>> print(f"{depth_loss(render(primitives.sphere(0.49), camera), observed).item():.3f}")
    0.018
    """
    both = buffers.mask & torch.isfinite(observed)
    return (buffers.depth[both] - observed[both]).abs().sum() / both.sum().clamp_min(1)


def normal_loss(buffers: Buffers, observed: Float[Tensor, "*batch 3"]) -> Tensor:
    """Returns the mean 1 − n · observed over the rays that hit and have an observed normal, of unit length.

    n are the footprint normals: exact normals of a ReLU network have no useful derivative.
    """
    both = buffers.mask & (observed.norm(dim=-1) > 0.5)
    return (1 - (buffers.footprint_normal[both] * observed[both]).sum(-1)).sum() / both.sum().clamp_min(1)


def silhouette_loss(buffers: Buffers, is_object: Bool[Tensor, "*batch"], tolerance: float) -> tuple[Tensor, Tensor]:
    """Returns two hinge losses on the clearance: of object rays that miss, and of background rays that come too near.

    Too near is below `tolerance`, a distance in the world. Both are means over all rays.
    """
    clearance = buffers.clearance
    hit = buffers.mask
    met = torch.isfinite(clearance)
    missing = clearance[is_object & ~hit & met].clamp_min(0)
    extra = (tolerance - clearance[~is_object & met]).clamp_min(0)
    count = max(is_object.numel(), 1)
    return missing.sum() / count, extra.sum() / count
