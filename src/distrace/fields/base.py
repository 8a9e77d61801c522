"""What a surface is: a callable from points to signed distances, and wrappers that turn one field into another."""

import reprlib
from collections.abc import Callable

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

SDF = Callable[[Float[Tensor, "*batch 3"]], Float[Tensor, "*batch"]]
"""A field: signed distances at points [*batch, 3], positive outside, negative inside, finite everywhere.

The default tracer evaluates it at up to 1.7 radii from the middle of its sphere.
"""


def evaluate_checked(sdf: SDF, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Returns the field's values. Raises `ValueError` where they are not one distance for each point.

    >>> evaluate_checked(lambda points: points.norm(dim=-1) - 0.5, torch.tensor([[0.0, 0.0, 2.0]]))
    tensor([1.5000])
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


def clamped_to_ball(points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Returns the nearest points of the unit ball, and the distances to them.

    A decoder is not trained beyond the ball; there its value at the nearest point plus the distance stands for it.

    >>> clamped_to_ball(torch.tensor([0.0, 0.0, 3.0]))
    (tensor([0., 0., 1.]), tensor(2.))
    """
    length = points.norm(dim=-1).clamp_min(1.0)
    return points / length[..., None], length - 1


def value_and_gradient(
    sdf: SDF, points: Float[Tensor, "*batch 3"], *, second_order: bool = True
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Returns the field's value and its gradient ∇f at each point, from one evaluation.

    Both are differentiable where grad mode is on. Without `second_order` the gradient is a constant, at half the cost.
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
                "the field's values are not connected to its points, so they have no gradient; is it under"
                " torch.no_grad, or does it detach its points?"
            )
        twice = keep_graph and second_order
        with torch.autocast(points.device.type, enabled=False):
            (gradient,) = torch.autograd.grad(value.sum(), points, retain_graph=keep_graph, create_graph=twice)
    return value if keep_graph else value.detach(), gradient


def chunked(sdf: SDF, size: int) -> SDF:
    """Returns the same field, evaluated at most `size` points at a time: a bound on memory, and on a CPU faster.

    >>> chunked(lambda points: points.norm(dim=-1) - 1, 100)(torch.zeros(1000, 3)).shape
    torch.Size([1000])
    """

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        flat = points.reshape(-1, 3)
        if len(flat) <= size:
            return evaluate_checked(sdf, points)
        return torch.cat([evaluate_checked(sdf, part) for part in flat.split(size)]).reshape(points.shape[:-1])

    return field


def flattened(
    function: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]], points: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Returns the values of a function of points [n, 3] at points of any shape."""
    return function(points) if points.dim() == 2 else function(points.reshape(-1, 3)).reshape(points.shape[:-1])


def in_chunks(function: Callable[..., Tensor], size: int, *rows: Shaped[Tensor, "n *_"]) -> Shaped[Tensor, "n *_"]:
    """Returns the values of a function of tensors of n rows, called with at most `size` rows of each at a time."""
    if len(rows[0]) <= size:
        return function(*rows)
    return torch.cat([function(*part) for part in zip(*(each.split(size) for each in rows), strict=True)])


def placed(sdf: SDF, T_world_object: Float[Tensor, "4 4"]) -> SDF:
    """Returns the field of an object that a similarity (rotation · scale, translation) maps to the world.

    Distances are scaled with the object, so the result is a signed distance again. Gradients reach the matrix.

    >>> twice = torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0]))
    >>> placed(lambda points: points.norm(dim=-1) - 0.5, twice)(torch.tensor([[0.0, 0.0, 3.0]]))
    tensor([2.])
    """
    linear = T_world_object[:3, :3]
    translation = T_world_object[:3, 3]
    scale = torch.linalg.det(linear) ** (1 / 3)

    def field(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return scale * sdf((points - translation) @ torch.linalg.inv(linear).T)

    return field


def pruned(sdf: SDF, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], SDF]:
    """Returns values at points, and a field with the same values around them: a cheaper one, if `sdf` has `pruned`."""
    prune = getattr(sdf, "pruned", None)
    return prune(points) if prune else (evaluate_checked(sdf, points), sdf)


def at_rows(sdf: SDF, rows: Int[Tensor, "m"]) -> SDF:
    """Returns the field for a subset of the points, by their numbers. Only a selection of shapes depends on them.

    `BatchField.select` returns such a selection: one shape for each point.
    """
    select = getattr(sdf, "at_rows", None)
    return select(rows) if select else sdf


class Counted:
    """A field that counts the points at which it is evaluated.

    >>> counted = Counted(lambda points: points.norm(dim=-1) - 0.5)
    >>> _ = counted(torch.zeros(7, 3))
    >>> counted.evaluations
    7
    """

    def __init__(self, sdf: SDF) -> None:
        self.sdf = sdf
        self.evaluations = 0

    def __repr__(self) -> str:
        return f"Counted({self.sdf!r}, {self.evaluations:,} evaluations)"

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        self.evaluations += points.numel() // 3
        return self.sdf(points)

    def pruned(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], SDF]:
        """Returns what the function of that name does; the pruned field counts here, too."""
        self.evaluations += len(points)
        values, field = pruned(self.sdf, points)
        return values, self.counting(field)

    def counting(self, field: SDF) -> SDF:
        """Returns another form of the same field, which counts here, too."""

        def count(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
            self.evaluations += points.numel() // 3
            return field(points)

        return count
