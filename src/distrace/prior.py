"""The prior of shapes: the Gaussian of the codes that a decoder was trained with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.equality import ByValue

LEAST_DEVIATION = 0.4  # of the mean deviation: on held-out sofas better than 0 and no worse than 1
START_DEVIATION = 0.7  # of the prior's, in draws of initial codes


@dataclass(frozen=True, eq=False, repr=False)
class Prior(ByValue):
    """A Gaussian of codes, mean + basis · w, with w of unit variance over the training codes."""

    mean: Float[Tensor, "length"]
    basis: Float[Tensor, "length dimensions"]
    codes: Sequence[Float[Tensor, "length"]] = ()  # the training codes

    def code(self, w: Float[Tensor, "dimensions"]) -> Float[Tensor, "length"]:
        """Returns the code of coordinates."""
        return self.mean + self.basis @ w

    def coordinates(self, code: Float[Tensor, "length"]) -> Float[Tensor, "dimensions"]:
        """Returns the coordinates w of a code."""
        return torch.linalg.solve(self.basis, code - self.mean)

    def start(self, k: int, seed: int) -> Float[Tensor, "dimensions"]:
        """Returns initial coordinates: the mean shape's, and for k > 0 a draw nearer to the mean than shapes are."""
        return self.draw(torch.Generator().manual_seed(seed + k), START_DEVIATION if k else 0.0)

    def draw(self, random: torch.Generator, deviation: float) -> Float[Tensor, "dimensions"]:
        """Returns the coordinates of a draw; `deviation` is in standard deviations of the prior."""
        return (torch.randn(self.basis.shape[1], generator=random) * deviation).to(self.mean)


def prior_of(codes: Float[Tensor, "shapes length"]) -> Prior:
    """Returns the Gaussian of training codes; of fewer than two that differ, DeepSDF's N(0, 0.1²) about them.

    Directions in which the training codes hardly differ keep a small deviation: unseen shapes need them.

    >>> prior = prior_of(torch.randn(10, 4))
    >>> prior.code(torch.zeros(4)).equal(prior.mean)
    True
    """
    length = codes.shape[1]
    mean = codes.mean(0) if len(codes) > 1 else codes.new_zeros(length)
    if (codes == codes[:1]).all():
        return Prior(mean, 0.1 * torch.eye(length, device=codes.device), tuple(codes))
    _, singular_values, directions = torch.linalg.svd((codes - mean) / math.sqrt(len(codes) - 1))
    deviations = codes.new_zeros(length)
    deviations[: len(singular_values)] = singular_values
    least = LEAST_DEVIATION * singular_values.mean()
    return Prior(mean, directions.T * (deviations**2 + least**2).sqrt(), tuple(codes))
