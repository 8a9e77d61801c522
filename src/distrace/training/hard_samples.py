"""Where a model that is learnt further is wrong: from there samples are drawn more often."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from distrace.checkpoints.model import VARIANT, Model
from distrace.training.batches import Samples

REACH = 0.02  # a sample so near to one whose sign is wrong counts as well, on whichever side of the surface
CERTAIN = 0.002  # the sign of a sample nearer to the surface says little


def dwelling(samples: Samples, model: Model, times: int) -> Samples:
    """The samples, with those of shapes that the model knows `times` over where it is wrong; variants stay as they are.

    The places are told once, and both of their sides are drawn alike: what counts more as long as its sign is wrong
    has its least loss at zero wherever signs are hard to tell, and flattens the field there.
    """
    parts = []
    for name, outside, inside in zip(samples.names, samples.outside, samples.inside, strict=True):
        if VARIANT not in name and name in model.shapes:
            wrong = _wrong_places(model, name, torch.cat([outside, inside]))
            chosen = wrong[: len(outside)], wrong[len(outside) :]
            outside, inside = (
                torch.cat([side, side[there].repeat(times - 1, 1)]) for side, there in zip((outside, inside), chosen)
            )
        parts.append((outside, inside))
    return Samples(samples.names, [outside for outside, _ in parts], [inside for _, inside in parts])


@torch.no_grad()
def _wrong_places(model: Model, name: str, samples: Float[Tensor, "n 4"]) -> Bool[Tensor, "n"]:
    """Which samples lie within REACH of one whose sign the model has wrong for certain."""
    values, distances = model.field(model.code_of(name))(samples[:, :3]), samples[:, 3]
    wrong = (values * distances < 0) & (distances.abs() > CERTAIN)
    if not wrong.any():
        return wrong
    points = samples[:, :3].cpu().numpy()
    off, _ = KDTree(points[wrong.cpu().numpy()]).query(points, distance_upper_bound=REACH)
    return torch.from_numpy(np.isfinite(off)).to(samples.device)
