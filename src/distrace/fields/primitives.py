"""Analytic fields: primitives as closures, and combinations of fields (after Quilez, *Distance functions*).

Parameters may be tensors that require grad; vectors may also be lists or tuples. Sizes are in the units of the world.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.base import SDF

Number = float | Tensor
Vector = Float[Tensor, "3"] | Sequence[float]


def sphere(radius: Number, centre: Vector | None = None) -> SDF:
    """|p − c| − r."""
    return lambda points: (points if centre is None else points - _vector(centre, points)).norm(dim=-1) - radius


def plane(normal: Vector, offset: Number = 0.0) -> SDF:
    """n · p − offset, solid on the side that the normal points away from."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        across = _vector(normal, points)
        return points @ (across / across.norm()) - offset

    return field


def box(half_extents: Vector) -> SDF:
    """An axis-aligned box around the origin."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        beyond = points.abs() - _vector(half_extents, points)
        return _length(beyond.clamp_min(0)) + beyond.amax(-1).clamp_max(0)

    return field


def torus(major: Number, minor: Number) -> SDF:
    """A ring of radius `major` in the xz plane, its tube of radius `minor`."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        around = _length(points[..., [0, 2]]) - major
        return _length(torch.stack([around, points[..., 1]], dim=-1)) - minor

    return field


def capsule(start: Vector, end: Vector, radius: Number) -> SDF:
    """All points within `radius` of the segment."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        first = _vector(start, points)
        axis = _vector(end, points) - first
        along = ((points - first) @ axis / (axis @ axis)).clamp(0, 1)
        return _length(points - first - along[..., None] * axis) - radius

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


def _vector(given: Vector, like: Tensor) -> Float[Tensor, "3"]:
    return given if isinstance(given, Tensor) else like.new_tensor(given)


def _length(vector: Tensor) -> Tensor:
    """The norm, with derivatives zero at zero, where torch's own second one is NaN: normals on faces of a box."""
    zero = (vector == 0).all(dim=-1)
    return vector.masked_fill(zero[..., None], 1.0).norm(dim=-1).masked_fill(zero, 0.0)
