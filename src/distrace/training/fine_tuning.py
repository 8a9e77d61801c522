"""Fine-tuning a model: distillation between the training shapes, and oversampling where its signs are wrong."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.checkpoints.model import VARIANT, Model
from distrace.fields.decoder import Decoder
from distrace.prior import Prior, prior_of
from distrace.training.batches import Samples, Side

MAX_CORRELATION = 0.9  # highest correlation with a training code, at which samples constrain the field
REACH = 0.02  # samples this near to one whose sign is wrong are oversampled too, on both sides of the surface
CERTAIN = 0.002  # signs of samples nearer to the surface are ignored


@dataclass(frozen=True)
class Distillation:
    """The original decoder, and the codes around which a fine-tuned one is compared with it.

    *Learning without Forgetting* (Li and Hoiem, ECCV 2016), of a field instead of a classifier.
    """

    decoder: Decoder
    codes: Float[Tensor, "shapes length"]  # the original codes of the shapes to train on
    prior: Prior
    others: Mapping[str, Float[Tensor, "length"]]  # codes of its shapes that have no samples: they stay

    @staticmethod
    def of(model: Model, names: Sequence[str]) -> "Distillation":
        """Returns the original `model`, for a training on shapes of these names."""
        others = {name: code for name, code in zip(model.shapes, model.codes, strict=True) if name not in names}
        return Distillation(model.decoder, model.codes_of(names), prior_of(model.codes), others)

    def drawn(self, shapes: Int[Tensor, "some"]) -> Float[Tensor, "some length"]:
        """Returns for each shape a random code between its own and a draw of the prior, with the prior's variance."""
        mean = self.prior.mean
        basis = self.prior.basis
        nearness = MAX_CORRELATION * torch.rand(len(shapes), 1).to(mean)
        draws = torch.randn(len(shapes), basis.shape[1]).to(mean) @ basis.T
        return mean + nearness * (self.codes[shapes.to(mean.device)] - mean) + (1 - nearness.square()).sqrt() * draws

    @torch.no_grad()
    def values(self, points: Float[Tensor, "some n 3"], codes: Float[Tensor, "some length"]) -> Float[Tensor, "some n"]:
        """Returns the original field's values."""
        return self.decoder(points, codes[:, None])


def oversampled(samples: Samples, model: Model, times: int) -> Samples:
    """Returns the samples, repeated `times` over where the model's signs are wrong; variants and new shapes as before.

    Places are chosen once, on both sides of the surface: a weight that a sample has only while its sign is wrong would
    pull the field to zero wherever signs are hard to learn.
    """
    outside = []
    inside = []
    for name, pos, neg in zip(samples.names, samples.outside.parts, samples.inside.parts, strict=True):
        if VARIANT not in name and name in model.shapes:
            wrong_pos, wrong_neg = _hard_samples(model, name, torch.cat([pos, neg])).split([len(pos), len(neg)])
            pos = torch.cat([pos, pos[wrong_pos].repeat(times - 1, 1)])
            neg = torch.cat([neg, neg[wrong_neg].repeat(times - 1, 1)])
        outside.append(pos)
        inside.append(neg)
    return Samples(samples.names, Side.of(outside), Side.of(inside))


@torch.no_grad()
def _hard_samples(model: Model, name: str, samples: Float[Tensor, "n 4"]) -> Bool[Tensor, "n"]:
    """Returns which samples lie within REACH of one whose sign the model has wrong."""
    from scipy.spatial import KDTree

    values = model.field(model.code_of(name))(samples[:, :3])
    distances = samples[:, 3]
    wrong = (values * distances < 0) & (distances.abs() > CERTAIN)
    if not wrong.any():
        return wrong
    points = samples[:, :3].cpu().numpy()
    off, _ = KDTree(points[wrong.cpu().numpy()]).query(points, distance_upper_bound=REACH)
    return torch.from_numpy(np.isfinite(off)).to(samples.device)
