"""Which of several shapes agrees best with photographs in which nobody has marked the object."""

import math
from collections.abc import Sequence

import torch

from distrace.fields.decoder import Decoder
from distrace.photos.residuals import Shape
from distrace.photos.stage import Comparing, Stage
from distrace.prior import Prior

SLIGHT = 1e-6  # of either: a shape whose outlines are all right is still judged by its colours


@torch.no_grad()
def contradictions(
    stage: Stage, decoder: Decoder, prior: Prior, shapes: Sequence[Shape], compared: Comparing, seed: int
) -> list[tuple[float, int]]:
    """Of each shape, how far it is off, by what all shapes together take for the object; and the evaluations.

    By its own loss a shape that lost its legs would be best: it calls them background, and compares them no more. What
    is told is the product of what colours and outlines are off by: how much of either is noise is not known, and a
    likelihood whose scales are the likeliest ones is a product of powers of them. Infinite where no point of a shape is
    seen by two views.
    """
    glimpses = [
        stage.glimpse(decoder, prior, shape, compared.rays, torch.Generator().manual_seed(seed)) for shape in shapes
    ]
    told = [stage.labels(glimpse) for glimpse in glimpses]
    common, found = [torch.stack(views).mean(0) for views in zip(*told, strict=True)], []
    for glimpse in glimpses:
        problem, look = stage.problem(glimpse, compared, common)
        terms = problem.terms(look, problem.residuals(look))
        outline = terms["outline"] * len(look.hit) / compared.rays  # of all rays: those kept are not the same for all
        off = (terms["colour"] + SLIGHT) * (outline + SLIGHT) if len(problem.pairs) else math.inf
        found.append((off, problem.evaluations))
    return found
