"""Functions of PyTorch that have no types there, with types."""

import torch
from jaxtyping import Float
from torch import Tensor


def length(vectors: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """Returns Euclidean lengths.

    >>> length(torch.tensor([3.0, 4.0]))
    tensor(5.)
    """
    return torch.linalg.vector_norm(vectors, dim=-1)


def perpendicular(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Returns a unit vector across each vector, which may have any direction but not length 0.

    >>> perpendicular(torch.tensor([0.0, 2.0, 0.0]))
    tensor([0., 0., 1.])
    """
    least = vectors.abs().argmin(-1, keepdim=True)
    axis = torch.zeros_like(vectors).scatter(-1, least, 1.0)
    return torch.nn.functional.normalize(torch.linalg.cross(axis, vectors), dim=-1)


def numbers(tensor: Tensor) -> str:
    """Returns all numbers of a tensor in words, for messages."""
    return str(tensor.tolist())
