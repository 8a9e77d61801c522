"""Positions and orientations of cameras, from numbers or from tensors with gradients and batch axes; checks of both."""

from collections.abc import Sequence
from functools import reduce
from numbers import Integral

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.errors import error_context
from distrace.vectors import numbers

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


def check_size(height: int, width: int) -> None:
    """Raises `ValueError` for a height or width that is no whole number from 1."""
    if not all(isinstance(size, Integral) and size >= 1 for size in (height, width)):
        raise ValueError(f"an image of {height} × {width} pixels was given; both must be whole numbers from 1")


def check_matrices(intrinsics: Tensor, T_world_camera: Tensor) -> None:
    """Raises `ValueError` for matrices that are not those of a camera."""
    if not (intrinsics.isfinite().all() and T_world_camera.isfinite().all()):
        raise ValueError("the camera's matrices hold values that are not finite")
    for name, matrix in (("intrinsics", intrinsics), ("T_world_camera", T_world_camera)):
        last = matrix.detach()[..., -1, :]
        if not torch.allclose(last, torch.eye(matrix.shape[-1], dtype=last.dtype, device=last.device)[-1]):
            raise ValueError(f"the last row of {name} is {numbers(last)}, not 0 … 0 1; is the matrix transposed?")
    focal = intrinsics.detach().diagonal(dim1=-2, dim2=-1)[..., :2]
    if not (focal > 0).all():
        raise ValueError(f"focal lengths of {numbers(focal)} pixels were given; they must be positive")
    if not (intrinsics.detach().det().abs() > 1e-6 * focal.prod(-1)).all():
        raise ValueError(f"the intrinsics {numbers(intrinsics)} have no inverse; they map camera axes to pixels")
    rotation = T_world_camera.detach()[..., :3, :3].double()
    error = (
        (rotation @ rotation.transpose(-1, -2) - torch.eye(3, dtype=torch.float64, device=rotation.device)).abs().max()
    )
    if error > 1e-3 or (rotation.det() < 0).any():
        raise ValueError(
            f"the upper left of T_world_camera is no rotation (off by {error:.2g}); it maps camera axes (x right,"
            " y down, z forward) to the world, without scale or mirroring"
        )


def _precision(given: Sequence[Tensor]) -> torch.dtype:
    """The widest precision of the tensors; float32 for integers and half precision, in which no camera is exact."""
    precise = reduce(torch.promote_types, (part.dtype for part in given if part.is_floating_point()), torch.float16)
    return torch.float64 if precise == torch.float64 else torch.float32


def _broadcast(subject: str, *parts: Tensor) -> tuple[Tensor, ...]:
    given = " and ".join(str(list(part.shape)) for part in parts)
    with error_context(f"{subject} of shapes {given} were given; they must have the same batch axes, or none"):
        return tuple(torch.broadcast_tensors(*parts))
