"""Distillation: a fine-tuned field stays close to the original one at codes between the training shapes.

*Learning without Forgetting* (Li and Hoiem, ECCV 2016), of a field instead of a classifier.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.checkpoints.model import Model
from distrace.fields.decoder import Decoder
from distrace.prior import Prior, prior_of

NEAREST = 0.9  # highest correlation with a training code, at which samples constrain the field


@dataclass(frozen=True)
class Kept:
    """The original decoder, and the codes around which a fine-tuned one is compared with it."""

    decoder: Decoder
    codes: Float[Tensor, "shapes length"]  # the original codes of the shapes to train on
    prior: Prior
    others: Mapping[str, Float[Tensor, "length"]]  # codes of its shapes that have no samples: they stay

    @staticmethod
    def of(model: Model, names: Sequence[str]) -> "Kept":
        """The original `model`, for a training on shapes of these names."""
        others = {name: code for name, code in zip(model.shapes, model.codes, strict=True) if name not in names}
        return Kept(model.decoder, model.codes_of(names), prior_of(model.codes), others)

    def drawn(self, shapes: Int[Tensor, "some"]) -> Float[Tensor, "some length"]:
        """For each shape a random code between its own and a draw of the prior, with the prior's variance."""
        mean = self.prior.mean
        basis = self.prior.basis
        nearness = NEAREST * torch.rand(len(shapes), 1).to(mean)
        draws = torch.randn(len(shapes), basis.shape[1]).to(mean) @ basis.T
        return mean + nearness * (self.codes[shapes.to(mean.device)] - mean) + (1 - nearness.square()).sqrt() * draws

    @torch.no_grad()
    def values(self, points: Float[Tensor, "some n 3"], codes: Float[Tensor, "some length"]) -> Float[Tensor, "some n"]:
        """The original field."""
        return self.decoder(points, codes[:, None])
