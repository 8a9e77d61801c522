"""Whether completions that differ say where they are wrong: the spread of several against the error of one."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.stats import rankdata

from distrace.data.observation import observe
from distrace.data.shapes import Shape
from distrace.fitting.continuation import CodeFitConfig
from distrace.fitting.free_space import completed
from distrace.fitting.methods import completing
from distrace.fitting.posterior import plausible, spread
from distrace.mesh import MeshConfig
from distrace.metrics import chamfer, surface_points
from distrace.processes import each_done
from experiments.tables.sparse_depth import camera_of, true_solid
from experiments.tables.trials import hash_of, opened_once

COMPLETIONS = 6  # whose spread is taken
POINTS = 100  # observed depths, besides the silhouette
LOOKED_AT = 5000  # points of the completed surface


@dataclass(frozen=True)
class SpreadRow:
    """A held-out shape seen once: the rank correlation of spread and error over its completed surface."""

    category: str
    shape: str
    correlation: float
    error_calm: float  # mean distance to the true surface of the half of it where completions agree best …
    error_apart: float  # … and of the other half
    chamfer: float
    seconds: float  # of all completions


def spread_rows(category: str, shapes: list[Shape], model: str, meshes: Path, jobs: int) -> Iterator[SpreadRow]:
    """Each of the shapes of a split."""
    return each_done(partial(_row, category, model, meshes), [shape.name for shape in shapes], jobs)


def _row(category: str, model: str, meshes: Path, name: str) -> SpreadRow:
    opened, truth, seed = opened_once(model), true_solid(meshes, category, name), hash_of(name)
    view = replace(observe(truth, camera_of(0)), normal=None).sparse(POINTS, seed)
    steps = list(completing(opened, view, CodeFitConfig()))
    others = list(plausible(opened, view, COMPLETIONS, seed=seed))
    mesh = completed(opened.field(steps[-1].code), view, MeshConfig())
    points = surface_points(mesh, LOOKED_AT, seed=0)
    apart = spread(opened, [step.code for step in others], torch.tensor(points, dtype=torch.float32)).numpy()
    error, calm = truth.apart(points), apart < np.median(apart)
    return SpreadRow(
        category,
        name,
        float(np.corrcoef(rankdata(apart), rankdata(error))[0, 1]),
        float(error[calm].mean()),
        float(error[~calm].mean()),
        chamfer(mesh, truth.surface).sum,
        sum(step.seconds for step in (*steps, *others)),
    )
