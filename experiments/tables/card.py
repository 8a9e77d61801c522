"""What to know of a model: its shapes beside the true ones, walks between codes, and what it was trained on."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.benchmarks.measuring import poster_view
from distrace.checkpoints.model import Model
from distrace.data.observation import pictured
from distrace.data.shapes import Shape
from distrace.data.solid import solid_of
from distrace.render import render
from distrace.report.completion_page import View
from distrace.shading import Picture, grid, in_rows, side_by_side

TILE = 128  # pixels
ACROSS = 8  # pairs in a row
WALKS, STRIDES = 4, 8


def pairs_picture(model: Model, shapes: Sequence[Shape], meshes: Path) -> Picture:
    """Of each training shape the true surface, and beside it what the model makes of its code."""
    camera, pairs = poster_view(TILE), []
    for shape in shapes:
        if shape.name in model.shapes:
            truth = pictured(solid_of(shape, meshes), camera)
            pairs.append(side_by_side([truth, _shaded(model, model.code_of(shape.name))], gap=0))
    blank = np.full_like(pairs[0], 255)
    pairs += [blank] * (-len(pairs) % min(ACROSS, len(pairs)))
    return in_rows(pairs, ACROSS)


def walks_picture(model: Model, shapes: Sequence[Shape]) -> Picture:
    """Straight walks between codes of training shapes that are far apart in the list, one in a row."""
    known = [model.shapes.index(shape.name) for shape in shapes if shape.name in model.shapes]
    some = known[:: max(len(known) // (2 * WALKS), 1)]
    return grid([[_shaded(model, code) for code in walk(model, *pair)] for pair in zip(some[0::2], some[1::2])][:WALKS])


def walk(model: Model, first: int, last: int) -> list[Float[Tensor, "length"]]:
    """Codes from one training shape's to another's, at even strides."""
    return [torch.lerp(model.codes[first], model.codes[last], k / (STRIDES - 1)) for k in range(STRIDES)]


def _shaded(model: Model, code: Float[Tensor, "length"]) -> Picture:
    with torch.no_grad():
        return View.of(render(model.field(code), poster_view(TILE))).shaded


def shapes_table(shapes: Sequence[Shape]) -> str:
    """Every shape of the split in Markdown: on which side it is, or why on none, and whose it is."""
    sides = {"train": "trained on", "test": "held out"}
    lines = [
        f"| {shape.name} | {sides.get(shape.split, f'left out: {shape.note}')} | {shape.creator} | {shape.licence} |"
        for shape in shapes
    ]
    return "\n".join(["| shape | | creator | licence |", "|---|---|---|---|", *lines])
