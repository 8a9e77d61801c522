"""Fields that are not what sphere tracing assumes: too steep, too thin, too wild, too close, or clamped."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from distrace.camera import Camera
from distrace.fields.base import SDF
from distrace.fields.primitives import box, sphere

CLAMP = 0.02
THICKNESS = 0.004
FREQUENCY, AMPLITUDE = 30.0, 0.06


@dataclass(frozen=True)
class Hard:
    """A field, and a bound on its slope, by which the reference divides it."""

    sdf: SDF
    steepest: float


def hard_fields(decoder: SDF, camera: Camera) -> Mapping[str, Hard]:
    """By name; `decoder` is any well-trained one, and a gap is as wide as one pixel of the camera."""
    like = camera.intrinsics
    pixel = float(2 * camera.tolerance(1.0).max() * camera.T_world_camera[:3, 3].norm())
    return {
        "decoder × 2": Hard(lambda points: 2 * decoder(points), 2.5),
        "thin plate": Hard(box(like.new_tensor([0.6, THICKNESS / 2, 0.4])), 1.0),
        "high frequencies": Hard(_wild(like), 1 + 2 * AMPLITUDE * FREQUENCY),
        "gap of a pixel": Hard(_gap(pixel, like), 1.0),
        "clamped": Hard(lambda points: decoder(points).clamp(-CLAMP, CLAMP), 1.2),
    }


def _wild(like: Tensor) -> SDF:
    """A sphere and waves in random directions, as a network of sines has (Sitzmann et al., *SIREN*, NeurIPS 2020)."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(16, 3, generator=generator), dim=-1).to(like) * FREQUENCY
    phases = (torch.rand(16, generator=generator) * 6.283).to(like)
    ball = sphere(0.6)
    return lambda points: ball(points) + AMPLITUDE * torch.sin(points @ directions.T + phases).mean(-1) * 2


def _gap(width: float, like: Tensor) -> SDF:
    """Two boxes side by side."""
    half = box(like.new_tensor([0.3, 0.4, 0.3]))
    aside = like.new_tensor([0.3 + width / 2, 0.0, 0.0])
    return lambda points: torch.minimum(half(points - aside), half(points + aside))
