"""Oversampling of places where the model to fine-tune has wrong signs."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.checkpoints.model import VARIANT, Model
from distrace.training.batches import Samples

REACH = 0.02  # samples this near to one whose sign is wrong are oversampled too, on both sides of the surface
CERTAIN = 0.002  # signs of samples nearer to the surface are ignored


def dwelling(samples: Samples, model: Model, times: int) -> Samples:
    """The samples, repeated `times` over where the model's signs are wrong; variants and new shapes stay as they are.

    Places are chosen once, on both sides of the surface: a weight that a sample has only while its sign is wrong would
    pull the field to zero wherever signs are hard to learn.
    """
    parts = []
    for name, outside, inside in zip(samples.names, samples.outside, samples.inside, strict=True):
        if VARIANT not in name and name in model.shapes:
            wrong = _wrong_places(model, name, torch.cat([outside, inside]))
            chosen = wrong[: len(outside)], wrong[len(outside) :]
            outside, inside = (
                torch.cat([side, side[near].repeat(times - 1, 1)]) for side, near in zip((outside, inside), chosen)
            )
        parts.append((outside, inside))
    return Samples(samples.names, [outside for outside, _ in parts], [inside for _, inside in parts])


@torch.no_grad()
def _wrong_places(model: Model, name: str, samples: Float[Tensor, "n 4"]) -> Bool[Tensor, "n"]:
    """Which samples lie within REACH of one whose sign the model has wrong."""
    from scipy.spatial import KDTree

    values = model.field(model.code_of(name))(samples[:, :3])
    distances = samples[:, 3]
    wrong = (values * distances < 0) & (distances.abs() > CERTAIN)
    if not wrong.any():
        return wrong
    points = samples[:, :3].cpu().numpy()
    off, _ = KDTree(points[wrong.cpu().numpy()]).query(points, distance_upper_bound=REACH)
    return torch.from_numpy(np.isfinite(off)).to(samples.device)
