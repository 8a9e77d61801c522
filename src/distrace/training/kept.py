"""What a model that is learnt further was between its shapes: it is to stay so where no sample tells.

Learning without Forgetting (Li and Hoiem, ECCV 2016), of a field instead of a classifier.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.checkpoint import Model
from distrace.decoder import Decoder
from distrace.fitting.prior import Prior, prior_of

NEAREST = 0.9  # correlation with a code that was learnt, at most: there samples tell


@dataclass(frozen=True)
class Kept:
    """A decoder as it was, and the codes at which another is compared with it."""

    decoder: Decoder
    codes: Float[Tensor, "shapes length"]  # of the shapes to learn, as they were
    prior: Prior

    @staticmethod
    def of(model: Model, names: Sequence[str]) -> "Kept":
        """Of shapes that the model does not know, the mean code."""
        prior, known = prior_of(model.codes), dict(zip(model.shapes, model.codes, strict=True))
        return Kept(model.decoder, torch.stack([known.get(name, prior.mean) for name in names]), prior)

    def drawn(self, shapes: Int[Tensor, "some"]) -> Float[Tensor, "some length"]:
        """For each shape a code somewhere between its own and a draw of the prior, and as likely as both."""
        nearness = NEAREST * torch.rand(len(shapes), 1)
        draws = (torch.randn(len(shapes), self.prior.basis.shape[1]) @ self.prior.basis.T.cpu()).to(self.codes)
        apart = self.codes[shapes.to(self.codes.device)] - self.prior.mean
        nearness = nearness.to(self.codes)
        return self.prior.mean + nearness * apart + (1 - nearness**2).sqrt() * draws

    @torch.no_grad()
    def values(self, points: Float[Tensor, "some n 3"], codes: Float[Tensor, "some length"]) -> Float[Tensor, "some n"]:
        """What the field was there."""
        return self.decoder(points, codes[:, None])
