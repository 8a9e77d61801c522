"""Which shape agrees best with photographs, and which photographs disagree with a shape that was fitted to all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.photos.photo_set import PhotoSet
from distrace.photos.problem import PhotoProblem, PlacedShape, TracedShape
from distrace.photos.visual_hull import outlier_limit

LEAST_DIFFERENCE = 0.03  # of colours, from 0 to 1: noise and a change of light alone differ by as much


@torch.no_grad()
def inconsistencies(photos: PhotoSet, shapes: Sequence[PlacedShape], seed: int) -> tuple[list[float], int]:
    """Each shape's inconsistency with labels that are averaged over all shapes; and the evaluations of all.

    By its own labels a shape that lost its legs would be best, since it takes them for background. The inconsistency
    is the product of the colour and outline terms: their noise is unknown, and the likelihood under the likeliest
    scales is a product of their powers. Infinite where no point of a shape is seen by two views.
    """
    rays = photos.config.rays
    samples = [photos.sample(shape, rays, torch.Generator().manual_seed(0)) for shape in shapes]
    labels = [torch.stack(views).mean(0) for views in zip(*map(photos.labels, samples), strict=True)]
    found = []
    evaluations = 0
    for sample in samples:
        problem, state = photos.problem(sample, labels)
        terms = problem.terms(state, problem.residuals(state))
        outline = terms["outline"] * len(state.hit) / rays  # per drawn ray: how many are used differs
        product = (terms["colour"] + 1e-6) * (outline + 1e-6)  # colours still count where all outlines are right
        found.append(product if len(problem.pairs) else math.inf)
        evaluations += problem.evaluations
    return found, evaluations


@dataclass(frozen=True)
class ViewAgreement:
    """The median difference of a view's colours, from 0 to 1, to those of the same points in other views.

    NaN where no other view sees a point of it.
    """

    name: str
    colour: float
    is_outlier: bool  # most often the camera is wrong


def view_agreements(photos: PhotoSet, shape: PlacedShape) -> list[ViewAgreement]:
    """Each view's agreement with the others, by the lower median over them: one of them may have a wrong camera."""
    sample = photos.sample(shape, photos.config.rays, torch.Generator().manual_seed(0))
    differences = _pairwise_differences(*photos.problem(sample), len(photos.photographs)).nanmedian(1).values
    limit = outlier_limit(differences[differences.isfinite()].tolist(), LEAST_DIFFERENCE)
    return [
        ViewAgreement(photograph.name, difference, difference > limit)
        for photograph, difference in zip(photos.photographs, differences.tolist(), strict=True)
    ]


def _pairwise_differences(problem: PhotoProblem, state: TracedShape, count: int) -> Float[Tensor, "views views"]:
    """The median difference of colour between each two views; NaN where they see no point in common."""
    values = problem.residuals(state).values[: 3 * len(problem.pairs)].reshape(-1, 3)
    differences = values.abs().mean(dim=-1) * problem.config.colour_scale
    first = problem.view[problem.pairs[:, 0]]
    second = problem.pairs[:, 1]
    found = torch.full((count, count), torch.nan)
    for a in range(count):
        for b in range(a):
            both = ((first == a) & (second == b)) | ((first == b) & (second == a))
            found[a, b] = found[b, a] = differences[both].median() if both.any() else torch.nan
    return found
