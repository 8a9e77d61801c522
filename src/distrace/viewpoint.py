"""Positions and orientations of cameras, from numbers or from tensors with gradients and batch axes."""

from collections.abc import Sequence
from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.errors import explained

Number = float | Tensor
Point = Tensor | tuple[float, float, float]
"""Tensors are [3] or [*batch, 3]."""


def orbiting(
    azimuth: Number, elevation: Number, distance: Number, dtype: torch.dtype | None = None
) -> Float[Tensor, "*batch 3"]:
    """Returns distance · (sin az · cos el, sin el, cos az · cos el) for angles in degrees.

    Tensors keep their gradients and are broadcast. `dtype` is by default that of the tensors, of numbers float32.
    Raises `ValueError` for values that are not finite, and for tensors whose shapes do not fit.
    """
    given = [part for part in (azimuth, elevation, distance) if isinstance(part, Tensor)]
    dtype = dtype or _precision(given)
    precise = dtype if given else torch.float64  # numbers are rounded once
    device = given[0].device if given else None
    parts = [torch.as_tensor(part, dtype=precise, device=device) for part in (azimuth, elevation, distance)]
    az, el, away = _broadcast("azimuth, elevation and distance", *parts)
    if not (az.isfinite() & el.isfinite() & away.isfinite()).all():
        turn, rise, reach = (part.tolist() for part in parts)
        raise ValueError(f"an orbit at {turn}°, {rise}°, {reach} was given; all three must be finite")
    az = torch.deg2rad(az)
    el = torch.deg2rad(el)
    unit = torch.stack([az.sin() * el.cos(), el.sin(), az.cos() * el.cos()], dim=-1)
    return unit.to(dtype) * away.to(dtype)[..., None]


def together(eye: Point, target: Point) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Returns two points as tensors of one shape. Raises `ValueError` where they have none in common."""
    like = next((part for part in (eye, target) if isinstance(part, Tensor)), torch.empty(0))
    first, second = (part if isinstance(part, Tensor) else like.new_tensor(part) for part in (eye, target))
    if first.shape[-1:] != (3,) or second.shape[-1:] != (3,):
        given = f"{list(first.shape)} and {list(second.shape)}"
        raise ValueError(f"an eye and a target of shapes {given} were given; both are [3] or [*batch, 3]")
    first, second = _broadcast("an eye and a target", first, second)
    return first, second


def upright(forward: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Returns the rotation that maps z to the unit vector `forward`, and y down in the image.

    World y is up; a camera that looks along it has z up instead.
    """
    vertical = forward[..., 1:2].abs() >= 1 - 1e-6
    up = torch.where(vertical, forward.new_tensor([0.0, 0.0, 1.0]), forward.new_tensor([0.0, 1.0, 0.0]))
    right = torch.linalg.cross(forward, up)
    right = right / right.norm(dim=-1, keepdim=True)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-1)


def _precision(given: Sequence[Tensor]) -> torch.dtype:
    """The widest precision of the tensors; float32 for integers and half precision, in which no camera is exact."""
    precise = reduce(torch.promote_types, (part.dtype for part in given if part.is_floating_point()), torch.float16)
    return torch.float64 if precise == torch.float64 else torch.float32


def _broadcast(subject: str, *parts: Tensor) -> tuple[Tensor, ...]:
    given = " and ".join(str(list(part.shape)) for part in parts)
    with explained(f"{subject} of shapes {given} were given; they must have the same batch axes, or none"):
        return tuple(torch.broadcast_tensors(*parts))
