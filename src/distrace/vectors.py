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


def numbers(tensor: Tensor) -> str:
    """Returns all numbers of a tensor in words, for messages."""
    return str(tensor.tolist())
