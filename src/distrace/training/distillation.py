"""What a model that is learnt further was between its shapes: it stays so where no sample tells.

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

NEAREST = 0.9  # correlation with a code that is learnt, at most: there samples tell


@dataclass(frozen=True)
class Kept:
    """A decoder as it was, and about which codes another is compared with it."""

    decoder: Decoder
    codes: Float[Tensor, "shapes length"]  # of the shapes to learn, as they were
    prior: Prior
    others: Mapping[str, Float[Tensor, "length"]]  # codes of what it knew and no sample tells: they stay its shapes

    @staticmethod
    def of(model: Model, names: Sequence[str]) -> "Kept":
        """About what the model knows of shapes of these names."""
        others = {name: code for name, code in zip(model.shapes, model.codes, strict=True) if name not in names}
        return Kept(model.decoder, model.codes_of(names), prior_of(model.codes), others)

    def drawn(self, shapes: Int[Tensor, "some"]) -> Float[Tensor, "some length"]:
        """For each of the shapes a code anywhere between its own and a draw of the prior, and as usual as both."""
        mean, basis = self.prior.mean, self.prior.basis
        nearness = NEAREST * torch.rand(len(shapes), 1).to(mean)
        draws = torch.randn(len(shapes), basis.shape[1]).to(mean) @ basis.T
        return mean + nearness * (self.codes[shapes.to(mean.device)] - mean) + (1 - nearness.square()).sqrt() * draws

    @torch.no_grad()
    def values(self, points: Float[Tensor, "some n 3"], codes: Float[Tensor, "some length"]) -> Float[Tensor, "some n"]:
        """What the field was."""
        return self.decoder(points, codes[:, None])
