"""Analytic fields: primitives as closures, and combinations of fields (after Quilez, *Distance functions*).

Parameters may be tensors that require grad; vectors may also be lists or tuples. Sizes are in the units of the world.
All primitives are exact distances.

>>> bowl = difference(sphere(0.5), sphere(0.4), box([1, 1, 1]))
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.base import SDF

Number = float | Tensor
Vector = Float[Tensor, "3"] | Sequence[float]


def sphere(radius: Number, centre: Vector | None = None) -> SDF:
    """Returns the field of a ball, |p − centre| − radius; the centre is the origin by default.

    >>> sphere(0.5)(torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]))
    tensor([ 1.5000, -0.5000])
    """
    return lambda points: (points if centre is None else points - _vector(centre, points)).norm(dim=-1) - radius


def plane(normal: Vector, offset: Number = 0.0) -> SDF:
    """Returns the field of a half-space, n · p − offset with n = normal / |normal|; n points out of the solid.

    >>> plane([0, 2, 0], 0.5)(torch.tensor([[0.0, 2.0, 0.0]]))
    tensor([1.5000])
    """

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        across = _vector(normal, points)
        return points @ (across / across.norm()) - offset

    return field


def box(half_extents: Vector) -> SDF:
    """Returns the field of an axis-aligned box around the origin, from −half_extents to half_extents.

    >>> box([1, 2, 3])(torch.tensor([[0.0, 0.0, 4.0]]))
    tensor([1.])
    """

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        beyond = points.abs() - _vector(half_extents, points)
        return _length(beyond.clamp_min(0)) + beyond.amax(-1).clamp_max(0)

    return field


def torus(major: Number, minor: Number) -> SDF:
    """Returns the field of a ring of radius `major` in the xz plane, whose tube has radius `minor`.

    >>> torus(0.5, 0.2)(torch.tensor([[1.0, 0.0, 0.0]]))
    tensor([0.3000])
    """

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        around = _length(points[..., [0, 2]]) - major
        return _length(torch.stack([around, points[..., 1]], dim=-1)) - minor

    return field


def capsule(start: Vector, end: Vector, radius: Number) -> SDF:
    """Returns the field of all points within `radius` of the segment from `start` to `end`.

    >>> capsule([0, 0, 0], [0, 1, 0], 0.25)(torch.tensor([[0.0, 2.0, 0.0]]))
    tensor([0.7500])
    """

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        first = _vector(start, points)
        axis = _vector(end, points) - first
        along = ((points - first) @ axis / (axis @ axis)).clamp(0, 1)
        return _length(points - first - along[..., None] * axis) - radius

    return field


def cylinder(radius: Number, half_height: Number) -> SDF:
    """Returns the field of a cylinder around the y axis, from −half_height to half_height.

    >>> cylinder(0.5, 1.0)(torch.tensor([[2.0, 0.0, 0.0]]))
    tensor([1.5000])
    """

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        beyond = torch.stack([_length(points[..., [0, 2]]) - radius, points[..., 1].abs() - half_height], dim=-1)
        return _length(beyond.clamp_min(0)) + beyond.amax(-1).clamp_max(0)

    return field


def union(*fields: SDF) -> SDF:
    """Returns the least value of the fields: exact outside, a bound inside.

    >>> union(sphere(0.5), sphere(1.0))(torch.tensor([[2.0, 0.0, 0.0]]))
    tensor([1.])
    """
    return lambda points: torch.stack([field(points) for field in fields]).amin(0)


def intersection(*fields: SDF) -> SDF:
    """Returns the greatest value of the fields: a lower bound of the distance outside.

    >>> intersection(sphere(0.5), sphere(1.0))(torch.tensor([[2.0, 0.0, 0.0]]))
    tensor([1.5000])
    """
    return lambda points: torch.stack([field(points) for field in fields]).amax(0)


def difference(field: SDF, *removed: SDF) -> SDF:
    """Returns the field of the first solid without the others.

    >>> difference(sphere(1.0), sphere(0.5))(torch.zeros(1, 3))
    tensor([0.5000])
    """
    return intersection(field, *(lambda points, solid=solid: -solid(points) for solid in removed))


def smooth_union(first: SDF, second: SDF, width: Number) -> SDF:
    """Returns a union whose crease is filled over `width`; still 1-Lipschitz.

    >>> smooth_union(sphere(0.5), sphere(0.5), 0.4)(torch.tensor([[1.0, 0.0, 0.0]]))
    tensor([0.4000])
    """

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        a = first(points)
        b = second(points)
        overlap = (width - (a - b).abs()).clamp_min(0) / width
        return torch.minimum(a, b) - overlap**2 * width / 4

    return field


def rounded(field: SDF, radius: Number) -> SDF:
    """Returns the field of a solid grown by `radius`, its edges round.

    >>> rounded(box([1, 1, 1]), 0.5)(torch.tensor([[2.0, 0.0, 0.0]]))
    tensor([0.5000])
    """
    return lambda points: field(points) - radius


def _vector(given: Vector, like: Tensor) -> Float[Tensor, "3"]:
    return given if isinstance(given, Tensor) else like.new_tensor(given)


def _length(vector: Tensor) -> Tensor:
    """Returns the norm; its derivatives at zero are zero, where torch's second one is NaN (on the faces of a box)."""
    zero = (vector == 0).all(dim=-1)
    return vector.masked_fill(zero[..., None], 1.0).norm(dim=-1).masked_fill(zero, 0.0)
