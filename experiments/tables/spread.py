"""Correlates the spread of several completions with the error of one."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.stats import rankdata

from distrace.data.shapes import Shape
from distrace.fitting.completing import complete_shape, posterior_codes, posterior_deviation
from distrace.fitting.fit_code import CodeFitConfig
from distrace.fitting.free_space import pruned_mesh
from distrace.mesh import MeshConfig
from distrace.metrics import chamfer, surface_points
from distrace.processes import parallel_map
from experiments.datasets.solids import observe
from experiments.tables.sparse_depth import camera_of, true_solid
from experiments.tables.trials import hash_of, opened_once

COMPLETIONS = 6  # that the spread is taken over
POINTS = 100  # observed depths, in addition to the silhouette
SURFACE_POINTS = 5000  # of the completed surface


@dataclass(frozen=True)
class SpreadRow:
    """The rank correlation of spread and error over the completed surface of a held-out shape."""

    category: str
    shape: str
    correlation: float
    error_calm: float  # mean distance to the true surface, on the half where completions agree best
    error_apart: float  # the same on the other half
    chamfer: float
    seconds: float  # of all completions


def spread_rows(
    category: str, shapes: list[Shape], model: str, meshes: Path, jobs: int, cluster: str | None = None
) -> Iterator[SpreadRow]:
    """Yields a row for each shape."""
    return parallel_map(partial(_row, category, model, meshes), [shape.name for shape in shapes], jobs, cluster)


def _row(category: str, model: str, meshes: Path, name: str) -> SpreadRow:
    network = opened_once(model)
    truth = true_solid(meshes, category, name)
    seed = hash_of(name)
    view = replace(observe(truth, camera_of(0)), normal=None).sparse(POINTS, seed)
    began = time.perf_counter()
    fit = complete_shape(network, view, CodeFitConfig())
    others, _ = posterior_codes(network, view, COMPLETIONS, CodeFitConfig(seed=seed))
    seconds = time.perf_counter() - began
    mesh = pruned_mesh(network.field(fit.code), view, MeshConfig())
    points = surface_points(mesh, SURFACE_POINTS, seed=0)
    deviation = posterior_deviation(network, others, torch.tensor(points, dtype=torch.float32)).numpy()
    error = truth.apart(points)
    calm = deviation < np.median(deviation)
    return SpreadRow(
        category,
        name,
        float(np.corrcoef(rankdata(deviation), rankdata(error))[0, 1]),
        float(error[calm].mean()),
        float(error[~calm].mean()),
        chamfer(mesh, truth.surface).sum,
        seconds,
    )
