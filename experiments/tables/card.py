"""Pictures and the table of a model card: shapes and the true ones, walks between codes, training shapes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.antialiasing import clay_picture
from distrace.benchmarks.measuring import poster_view
from distrace.checkpoints.model import Model
from distrace.data.shapes import Shape
from distrace.render import render
from distrace.shading import Picture, grid, side_by_side
from experiments.datasets.pictured import pictured
from experiments.datasets.solids import solid_of

TILE = 128  # pixels
ACROSS = 8  # pairs in a row
WALKS = 4
STEPS = 8  # of a walk


def pairs_picture(model: Model, shapes: Sequence[Shape], meshes: Path) -> Picture:
    """Returns each training shape's true surface next to the surface of its code."""
    camera = poster_view(TILE)
    pairs = []
    for shape in shapes:
        if shape.name in model.shapes:
            truth = pictured(solid_of(shape, meshes), camera)
            pairs.append(side_by_side([truth, _shaded(model, model.code_of(shape.name))], gap=0))
    blank = np.full_like(pairs[0], 255)
    pairs += [blank] * (-len(pairs) % min(ACROSS, len(pairs)))
    return grid([pairs[k : k + ACROSS] for k in range(0, len(pairs), ACROSS)])


def walks_picture(model: Model, shapes: Sequence[Shape]) -> Picture:
    """Returns a row for each walk between codes of training shapes that are far apart in the list."""
    codes = [model.shapes.index(shape.name) for shape in shapes if shape.name in model.shapes]
    ends = codes[:: max(len(codes) // (2 * WALKS), 1)]
    return grid([[_shaded(model, code) for code in walk(model, *pair)] for pair in zip(ends[0::2], ends[1::2])][:WALKS])


def walk(model: Model, first: int, last: int) -> list[Float[Tensor, "length"]]:
    """Returns codes at equal steps between two training shapes."""
    return [torch.lerp(model.codes[first], model.codes[last], k / (STEPS - 1)) for k in range(STEPS)]


def _shaded(model: Model, code: Float[Tensor, "length"]) -> Picture:
    with torch.no_grad():
        return clay_picture(render(model.field(code), poster_view(TILE)))


def shapes_table(shapes: Sequence[Shape]) -> str:
    """Returns the split as a Markdown table: side or reason, creator and licence of each shape."""
    sides = {"train": "trained on", "test": "held out"}
    lines = [
        f"| {shape.name} | {sides.get(shape.split, f'left out: {shape.note}')} | {shape.creator} | {shape.licence} |"
        for shape in shapes
    ]
    return "\n".join(["| shape | | creator | licence |", "|---|---|---|---|", *lines])
