"""Tables of a model's training and held-out shapes, and of completion from one sparse view."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
import trimesh

from distrace.benchmarks.measuring import poster_view
from distrace.checkpoints.model import Model
from distrace.data.samples import sample
from distrace.data.shapes import Shape
from distrace.data.solid import Solid
from distrace.fitting.fit_code import CodeFitConfig, fit_points
from distrace.fitting.free_space import pruned_mesh
from distrace.mesh import MeshConfig, extract_mesh
from distrace.metrics import chamfer
from distrace.prior import prior_of
from distrace.shading import Picture, grid
from experiments.datasets.pictured import pictured
from experiments.datasets.solids import observe, solid_of
from experiments.tables.methods import METHODS, completed_by, observation_of

OBSERVATION_SIZE = 256
SAMPLES = 40_000  # distances that a held-out shape is fitted to
SAMPLES_NEAR = 0.5  # share of them near the surface; the rest covers free space
SAMPLES_FIT = CodeFitConfig(iterations=40, points=2000, deviation=0.001)  # the prior hardly counts


@dataclass(frozen=True)
class Result:
    """A predicted surface and the true one."""

    shape: str
    method: str
    points: int  # observed; 0 for a training code
    chamfer_to: float
    chamfer_from: float
    chamfer: float
    seconds: float
    mesh: trimesh.Trimesh
    truth: trimesh.Trimesh

    def row(self, model: str) -> dict[str, str | int | float]:
        return {
            "model": model,
            "shape": self.shape,
            "points": self.points,
            "method": self.method,
            "chamfer_to": round(self.chamfer_to, 4),
            "chamfer_from": round(self.chamfer_from, 4),
            "chamfer": round(self.chamfer, 4),
            "seconds": round(self.seconds, 1),
        }


def training_results(model: Model, shapes: list[Shape], meshes: Path, resolution: int) -> Iterator[Result]:
    """Yields each training shape by its code, against the outer surface of its mesh."""
    for shape in shapes:
        if shape.name in model.shapes:
            mesh = extract_mesh(model.field(model.code_of(shape.name)), MeshConfig(resolution))
            yield compared(shape.name, "training code", 0, mesh, solid_of(shape, meshes).surface, 0.0)


def held_out_results(model: Model, shapes: list[Shape], meshes: Path, resolution: int) -> Iterator[Result]:
    """Yields each held-out shape by the code that fits distances all around it."""
    for shape in shapes:
        yield fit_to_distances(model, shape.name, solid_of(shape, meshes), resolution)


def fit_to_distances(model: Model, name: str, solid: Solid, resolution: int) -> Result:
    """Returns the best representation of a solid by the model."""
    samples = torch.from_numpy(sample(solid, SAMPLES, seed=0, near=SAMPLES_NEAR))
    fit = fit_points(model.decoder, samples, prior_of(model.codes), SAMPLES_FIT)
    mesh = extract_mesh(model.field(fit.code), MeshConfig(resolution))
    return compared(name, "all distances", 0, mesh, solid.surface, fit.seconds)


def completion_results(
    model: Model, shapes: list[Shape], meshes: Path, points: int, config: CodeFitConfig, resolution: int
) -> Iterator[Result]:
    """Yields each held-out shape, completed from `points` depths of one view by each method."""
    for shape in shapes:
        solid = solid_of(shape, meshes)
        view = observe(solid, poster_view(OBSERVATION_SIZE)).sparse(points, config.seed)
        for method in METHODS:
            observation = observation_of(view, method)
            fit = completed_by(method, model, observation, config)
            mesh = pruned_mesh(model.field(fit.code), observation, MeshConfig(resolution))
            yield compared(shape.name, method, points, mesh, solid.surface, fit.seconds)


def compared(
    shape: str, method: str, points: int, mesh: trimesh.Trimesh, truth: trimesh.Trimesh, seconds: float
) -> Result:
    distance = chamfer(mesh, truth)
    return Result(shape, method, points, distance.to, distance.from_, distance.sum, seconds, mesh, truth)


def summary(results: list[Result]) -> dict[str, dict[str, float]]:
    """Returns mean, median and worst Chamfer distance of each method."""
    values = {
        method: np.array([result.chamfer for result in results if result.method == method])
        for method in dict.fromkeys(result.method for result in results)
    }
    return {
        method: {"mean": float(chamfers.mean()), "median": float(np.median(chamfers)), "worst": float(chamfers.max())}
        for method, chamfers in values.items()
    }


def picture_of(results: list[Result]) -> Picture:
    """Returns a row for each shape: the true surface, then that of each method."""
    rows = []
    for _, group in groupby(results, key=lambda result: result.shape):
        of_shape = list(group)
        rows.append([rendered(mesh) for mesh in (of_shape[0].truth, *(result.mesh for result in of_shape))])
    return grid(rows)


def rendered(mesh: trimesh.Trimesh) -> Picture:
    """Renders a mesh from the poster's camera."""
    return pictured(Solid(mesh, mesh), poster_view(OBSERVATION_SIZE))
