"""Views that do not agree with the others about a shape that was fitted to all: most often their cameras are wrong."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.decoder import Decoder
from distrace.photos.residuals import Look, PhotoProblem, Shape
from distrace.photos.stage import Comparing, Stage
from distrace.prior import Prior

LEVEL = 0.5  # of the images' size
FAR_OFF = 2.5  # × the median over views: farther off than that, a view is doubtful …
NOTICEABLE = 0.03  # … if its colours, from 0 to 1, are off by that, too


@dataclass(frozen=True)
class Agreement:
    """The median difference of a view's colours, from 0 to 1, to those of the same points in others; NaN of none."""

    name: str
    colour: float
    doubtful: bool


def agreements(
    decoder: Decoder, photographs: Sequence[Photograph], prior: Prior, shape: Shape, config: Comparing, seed: int = 0
) -> list[Agreement]:
    """Of each view, by the views that are not doubtful: the worst is left out first, for it makes its partners bad."""
    stage = Stage.of(photographs, LEVEL, config)
    glimpse = stage.glimpse(decoder, prior, shape, config.rays, torch.Generator().manual_seed(seed))
    problem, look = stage.problem(glimpse, config)
    between, doubtful = _between(problem, look, len(photographs)), set[int]()
    while True:
        off = {view: _median(between[view], doubtful | {view}) for view in range(len(photographs))}
        left = {view: value for view, value in off.items() if view not in doubtful and math.isfinite(value)}
        worst = max(left, key=lambda view: left[view], default=-1)
        if len(left) < 3 or left[worst] <= max(FAR_OFF * median(left.values()), NOTICEABLE):
            return [Agreement(each.name, off[view], view in doubtful) for view, each in enumerate(photographs)]
        doubtful.add(worst)


def _between(problem: PhotoProblem, look: Look, count: int) -> Float[Tensor, "views views"]:
    """The median difference of colour between each two views; NaN where they see no point in common."""
    values = problem.residuals(look).values[: 3 * len(problem.pairs)].reshape(-1, 3)
    off = values.abs().mean(dim=-1) * problem.weights.colour_scale
    first, second = problem.seen.view[problem.pairs[:, 0]], problem.pairs[:, 1]
    found = torch.full((count, count), torch.nan)
    for a in range(count):
        for b in range(a):
            both = ((first == a) & (second == b)) | ((first == b) & (second == a))
            found[a, b] = found[b, a] = off[both].median() if both.any() else torch.nan
    return found


def _median(row: Float[Tensor, "views"], left_out: set[int]) -> float:
    """Of those that are not left out; NaN where none is known."""
    known = [float(value) for view, value in enumerate(row) if view not in left_out and value.isfinite()]
    return median(known or [math.nan])
