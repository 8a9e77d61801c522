"""Analytic fields: primitives as closures, and combinations of fields (after Quilez, *Distance functions*).

Parameters may be tensors that require grad. Sizes are in the units of the world.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.base import SDF

Number = float | Tensor


def sphere(radius: Number, centre: Float[Tensor, "3"] | None = None) -> SDF:
    """|p − c| − r."""
    return lambda points: (points if centre is None else points - centre).norm(dim=-1) - radius


def plane(normal: Float[Tensor, "3"], offset: Number = 0.0) -> SDF:
    """n · p − offset, solid on the side that the normal points away from."""
    unit = normal / normal.norm()
    return lambda points: points @ unit - offset


def box(half_extents: Float[Tensor, "3"]) -> SDF:
    """An axis-aligned box around the origin."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        beyond = points.abs() - half_extents
        return _length(beyond.clamp_min(0)) + beyond.amax(-1).clamp_max(0)

    return field


def torus(major: Number, minor: Number) -> SDF:
    """A ring of radius `major` in the xz plane, its tube of radius `minor`."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        around = _length(points[..., [0, 2]]) - major
        return _length(torch.stack([around, points[..., 1]], dim=-1)) - minor

    return field


def capsule(start: Float[Tensor, "3"], end: Float[Tensor, "3"], radius: Number) -> SDF:
    """All points within `radius` of the segment."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        axis = end - start
        along = ((points - start) @ axis / (axis @ axis)).clamp(0, 1)
        return _length(points - start - along[..., None] * axis) - radius

    return field


def cylinder(radius: Number, half_height: Number) -> SDF:
    """An upright cylinder around the origin."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        beyond = torch.stack([_length(points[..., [0, 2]]) - radius, points[..., 1].abs() - half_height], dim=-1)
        return _length(beyond.clamp_min(0)) + beyond.amax(-1).clamp_max(0)

    return field


def union(*fields: SDF) -> SDF:
    """The least value; exact outside, a bound inside."""
    return lambda points: torch.stack([field(points) for field in fields]).amin(0)


def intersection(*fields: SDF) -> SDF:
    """The greatest value: a lower bound of the distance outside."""
    return lambda points: torch.stack([field(points) for field in fields]).amax(0)


def difference(field: SDF, *removed: SDF) -> SDF:
    """The first solid without the others."""
    return intersection(field, *(lambda points, other=other: -other(points) for other in removed))


def smooth_union(first: SDF, second: SDF, width: Number) -> SDF:
    """A union whose crease is filled over `width`; still 1-Lipschitz."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        a, b = first(points), second(points)
        overlap = (width - (a - b).abs()).clamp_min(0) / width
        return torch.minimum(a, b) - overlap**2 * width / 4

    return field


def rounded(field: SDF, radius: Number) -> SDF:
    """The solid grown by `radius`, its edges round."""
    return lambda points: field(points) - radius


def _length(vector: Tensor) -> Tensor:
    """The norm, with derivatives zero at zero, where torch's own second one is NaN: normals on faces of a box."""
    zero = (vector == 0).all(dim=-1)
    return vector.masked_fill(zero[..., None], 1.0).norm(dim=-1).masked_fill(zero, 0.0)
