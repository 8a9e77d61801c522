"""Which shape agrees best with photographs, and which photographs disagree with a shape that was fitted to all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.decoder import Decoder
from distrace.photos.pyramid import PyramidLevel
from distrace.photos.residuals import ComparisonConfig, PhotoProblem, PlacedShape, TracedShape
from distrace.prior import Prior

LEAST_TERM = 1e-6  # added to either term: a shape whose outlines are all right is still judged by its colours
FACTOR = 0.5  # × the images' size, for the comparison of views
OUTLIER_FACTOR = 2.5  # × the median over views: a view whose difference is larger is an outlier …
LEAST_DIFFERENCE = 0.03  # … if its colours, from 0 to 1, differ by more than this, too


@torch.no_grad()
def inconsistencies(
    level: PyramidLevel,
    decoder: Decoder,
    prior: Prior,
    shapes: Sequence[PlacedShape],
    config: ComparisonConfig,
    seed: int,
) -> list[tuple[float, int]]:
    """Each shape's inconsistency with labels that are averaged over all shapes, and its evaluations.

    By its own labels a shape that lost its legs would be best, since it takes them for background. The inconsistency
    is the product of the colour and outline terms: their noise is unknown, and the likelihood under the likeliest
    scales is a product of their powers. Infinite where no point of a shape is seen by two views.
    """
    samples = [
        level.sample(decoder, prior, shape, config.rays, torch.Generator().manual_seed(seed)) for shape in shapes
    ]
    labels = [torch.stack(views).mean(0) for views in zip(*map(level.labels, samples), strict=True)]
    found = []
    for sample in samples:
        problem, state = level.problem(sample, config, labels)
        terms = problem.terms(state, problem.residuals(state))
        outline = terms["outline"] * len(state.hit) / config.rays  # per drawn ray: how many are kept differs
        product = (terms["colour"] + LEAST_TERM) * (outline + LEAST_TERM)
        found.append((product if len(problem.pairs) else math.inf, problem.evaluations))
    return found


@dataclass(frozen=True)
class ViewAgreement:
    """The median difference of a view's colours, from 0 to 1, to those of the same points in other views.

    NaN where no other view sees a point of it.
    """

    name: str
    colour: float
    is_outlier: bool  # most often the camera is wrong


def view_agreements(
    decoder: Decoder,
    photographs: Sequence[Photograph],
    prior: Prior,
    shape: PlacedShape,
    config: ComparisonConfig,
    seed: int = 0,
) -> list[ViewAgreement]:
    """Each view's agreement with the inliers. The worst outlier is removed first, since it spoils its neighbours."""
    level = PyramidLevel.of(photographs, FACTOR, config)
    sample = level.sample(decoder, prior, shape, config.rays, torch.Generator().manual_seed(seed))
    pairwise = _pairwise_differences(*level.problem(sample, config), len(photographs))
    outliers = set[int]()
    while True:
        differences = {view: _median(pairwise[view], outliers | {view}) for view in range(len(photographs))}
        inliers = {view: value for view, value in differences.items() if view not in outliers and math.isfinite(value)}
        worst = max(inliers, key=lambda view: inliers[view], default=-1)
        if len(inliers) < 3 or inliers[worst] <= max(OUTLIER_FACTOR * median(inliers.values()), LEAST_DIFFERENCE):
            return [
                ViewAgreement(photograph.name, differences[view], view in outliers)
                for view, photograph in enumerate(photographs)
            ]
        outliers.add(worst)


def _pairwise_differences(problem: PhotoProblem, state: TracedShape, count: int) -> Float[Tensor, "views views"]:
    """The median difference of colour between each two views; NaN where they see no point in common."""
    values = problem.residuals(state).values[: 3 * len(problem.pairs)].reshape(-1, 3)
    differences = values.abs().mean(dim=-1) * problem.config.colour_scale
    first = problem.observations.view[problem.pairs[:, 0]]
    second = problem.pairs[:, 1]
    found = torch.full((count, count), torch.nan)
    for a in range(count):
        for b in range(a):
            both = ((first == a) & (second == b)) | ((first == b) & (second == a))
            found[a, b] = found[b, a] = differences[both].median() if both.any() else torch.nan
    return found


def _median(row: Float[Tensor, "views"], excluded: set[int]) -> float:
    """The median over the other views; NaN where there is none."""
    values = [float(value) for view, value in enumerate(row) if view not in excluded and value.isfinite()]
    return median(values or [math.nan])
