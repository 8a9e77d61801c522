"""What a surface is: a callable from points to signed distances, and wrappers that turn one field into another."""

import reprlib
from collections.abc import Callable

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

SDF = Callable[[Float[Tensor, "*batch 3"]], Float[Tensor, "*batch"]]
"""Signed distance at points: positive outside, negative inside, the surface where it is zero; finite everywhere.

The default tracer asks for values up to 1.7 radii from the middle of its sphere.
"""


def asked(sdf: SDF, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """The field's values, after a look at what they are: fields are also what users write.

    Raises `ValueError` where they are not one distance for each point.
    """
    values = sdf(points)
    if not isinstance(values, Tensor) or values.shape != points.shape[:-1] or values.dtype != points.dtype:
        given = f"{values.dtype} of shape {list(values.shape)}" if isinstance(values, Tensor) else reprlib.repr(values)
        raise ValueError(
            f"the field gave {given} at points of shape {list(points.shape)}; one distance for each is needed,"
            f" {points.dtype} of shape {list(points.shape[:-1])}"
        )
    return values


def check_field(field: object) -> None:
    """Raises `TypeError` for what is no field; of a model, which holds many, it names the call that gives one.

    >>> check_field(lambda points: points.norm(dim=-1) - 0.5)
    """
    kind = type(field).__name__
    if callable(getattr(field, "field", None)):  # a model, or its decoder
        raise TypeError(f"a {kind} was given where a field is needed; take the one of a shape, model.field(code)")
    if not callable(field):
        raise TypeError(f"a {kind} was given where a field is needed; give a function from points to distances")


def value_and_gradient(
    sdf: SDF, points: Float[Tensor, "*batch 3"], *, second_order: bool = True
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """The field's value and its gradient ∇f at each point, from one evaluation.

    Where grad mode is on both are differentiable; without `second_order` the gradient is a constant, at half the cost.
    Raises `ValueError` for a field that autograd does not see through, and under `torch.inference_mode`.
    """
    if torch.is_inference_mode_enabled() or points.is_inference():
        raise ValueError("torch.inference_mode keeps no gradient, which a normal is; use torch.no_grad instead")
    keep_graph = torch.is_grad_enabled()
    with torch.enable_grad():
        points = points if points.requires_grad else points.detach().requires_grad_()
        value = sdf(points)
        if not value.requires_grad:
            raise ValueError(
                "the field's values do not know what points they came from, so they have no gradient; is it under"
                " torch.no_grad, or does it detach its points?"
            )
        twice = keep_graph and second_order
        with torch.autocast(points.device.type, enabled=False):
            (gradient,) = torch.autograd.grad(value.sum(), points, retain_graph=keep_graph, create_graph=twice)
    return value if keep_graph else value.detach(), gradient


def chunked(sdf: SDF, size: int) -> SDF:
    """The same field, evaluated at most `size` points at a time: a bound on memory, and on a CPU faster."""

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        flat = points.reshape(-1, 3)
        if len(flat) <= size:
            return asked(sdf, points)
        return torch.cat([asked(sdf, part) for part in flat.split(size)]).reshape(points.shape[:-1])

    return field


def flattened(
    function: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]], points: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """A function of points [n, 3], at points of any shape."""
    return function(points) if points.dim() == 2 else function(points.reshape(-1, 3)).reshape(points.shape[:-1])


def in_chunks(function: Callable[..., Tensor], size: int, *rows: Shaped[Tensor, "n *_"]) -> Shaped[Tensor, "n *_"]:
    """A function of tensors of n rows, called with at most `size` rows of each at a time."""
    if len(rows[0]) <= size:
        return function(*rows)
    return torch.cat([function(*part) for part in zip(*(each.split(size) for each in rows), strict=True)])


def placed(sdf: SDF, T_world_object: Float[Tensor, "4 4"]) -> SDF:
    """The field of an object moved into the world by a similarity (rotation · scale, translation).

    Distances are scaled with the object, so the result is a signed distance again.
    """
    linear, translation = T_world_object[:3, :3], T_world_object[:3, 3]
    scale = torch.linalg.det(linear) ** (1 / 3)

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return scale * sdf((points - translation) @ torch.linalg.inv(linear).T)

    return field


def narrowed(sdf: SDF, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], SDF]:
    """Values at points, and a field that is the same around them; cheaper, where the field has a way to be."""
    narrow = getattr(sdf, "narrowed", None)
    return narrow(points) if narrow else (asked(sdf, points), sdf)


def at_rows(sdf: SDF, rows: Int[Tensor, "m"]) -> SDF:
    """The field at some of the points that it was made for, by their numbers; most fields are made for any points.

    A selection of shapes, `BatchField.select`, is made for points in an order.
    """
    some = getattr(sdf, "at_rows", None)
    return some(rows) if some else sdf


class Counted:
    """The same field, counting the points that it was asked for."""

    def __init__(self, sdf: SDF) -> None:
        self.sdf = sdf
        self.evaluations = 0

    def __repr__(self) -> str:
        return f"Counted({self.sdf!r}, {self.evaluations:,} evaluations)"

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        self.evaluations += points.numel() // 3
        return self.sdf(points)

    def narrowed(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], SDF]:
        """As the function of that name; what it returns counts here, too."""
        self.evaluations += len(points)
        values, field = narrowed(self.sdf, points)
        return values, self.counting(field)

    def counting(self, field: SDF) -> SDF:
        """Another form of the same field, which counts here, too."""

        def count(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
            self.evaluations += points.numel() // 3
            return field(points)

        return count
