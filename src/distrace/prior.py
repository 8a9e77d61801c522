"""What is known of a shape before it is seen: the Gaussian of the codes that a decoder was trained with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.equality import ByValue

LEAST_DEVIATION = 0.4  # of the mean one: on held-out sofas better than none and no worse than 1
DEVIATION = 0.7  # of the prior's, in draws of starts


@dataclass(frozen=True, eq=False, repr=False)
class Prior(ByValue):
    """Codes as mean + basis · w, with w of unit variance over the training codes: steps follow what shapes do."""

    mean: Float[Tensor, "length"]
    basis: Float[Tensor, "length dimensions"]
    codes: Sequence[Float[Tensor, "length"]] = ()  # that it was estimated from

    def code(self, w: Float[Tensor, "dimensions"]) -> Float[Tensor, "length"]:
        return self.mean + self.basis @ w

    def coordinates(self, code: Float[Tensor, "length"]) -> Float[Tensor, "dimensions"]:
        return torch.linalg.solve(self.basis, code - self.mean)

    def start(self, k: int, seed: int) -> Float[Tensor, "dimensions"]:
        """The coordinates of the mean shape, and for k > 0 those of a draw: from nearer to the mean than shapes are."""
        return self.draw(torch.Generator().manual_seed(seed + k), DEVIATION if k else 0.0)

    def draw(self, random: torch.Generator, deviation: float) -> Float[Tensor, "dimensions"]:
        """Coordinates of a draw, in deviations of the prior."""
        return (torch.randn(self.basis.shape[1], generator=random) * deviation).to(self.mean)


def prior_of(codes: Float[Tensor, "shapes length"]) -> Prior:
    """The Gaussian of some training codes; of fewer than two that differ, DeepSDF's N(0, 0.1²) about them.

    Directions in which the training codes hardly differ keep a small deviation: shapes not trained on need them.
    """
    length = codes.shape[1]
    mean = codes.mean(0) if len(codes) > 1 else codes.new_zeros(length)
    if (codes == codes[:1]).all():
        return Prior(mean, 0.1 * torch.eye(length, device=codes.device), tuple(codes))
    _, found, directions = torch.linalg.svd((codes - mean) / math.sqrt(len(codes) - 1))
    deviations = codes.new_zeros(length)
    deviations[: len(found)] = found
    return Prior(mean, directions.T * (deviations**2 + (LEAST_DEVIATION * found.mean()) ** 2).sqrt(), tuple(codes))
