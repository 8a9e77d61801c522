"""Near-variants among shapes: the nearest neighbour of each, and the nearest training shape of held-out ones."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

from distrace.data.mesh_files import load_soup
from distrace.data.shapes import Shape
from distrace.data.solid import normalised
from distrace.metrics import surface_points
from experiments.datasets.solids import mesh_of

POINTS = 4000  # of each shape


@dataclass(frozen=True)
class Near:
    """A shape and its nearest neighbours."""

    shape: str
    split: str
    design: str
    nearest: str  # of another design
    nearest_split: str
    chamfer: float
    nearest_trained: str  # among the training shapes of other designs
    chamfer_trained: float


def used(shapes: list[Shape]) -> list[Shape]:
    """Returns the training and the held-out shapes."""
    return [shape for shape in shapes if shape.split != "out"]


def nearest_rows(shapes: list[Shape], meshes: Path, report: Callable[[str], None]) -> list[Near]:
    """Returns one row for each shape, the closest pairs first."""
    trees = []
    for shape in shapes:
        trees.append(KDTree(_points(shape, meshes)))
        report(shape.name)
    distances = np.array([[_one_sided(first, second) for second in trees] for first in trees])
    distances = distances + distances.T
    return sorted((_near(k, shapes, distances) for k in range(len(shapes))), key=lambda near: near.chamfer)


def _near(k: int, shapes: list[Shape], distances: np.ndarray) -> Near:
    other_design = np.array([shape.design != shapes[k].design for shape in shapes])
    trained = other_design & np.array([shape.split == "train" for shape in shapes])
    nearest = int(np.where(other_design, distances[k], np.inf).argmin())
    nearest_trained = int(np.where(trained, distances[k], np.inf).argmin())
    shape = shapes[k]
    return Near(
        shape.name,
        shape.split,
        shape.design,
        shapes[nearest].name,
        shapes[nearest].split,
        round(float(distances[k, nearest]), 3),
        shapes[nearest_trained].name,
        round(float(distances[k, nearest_trained]), 3),
    )


def _points(shape: Shape, meshes: Path) -> Float[np.ndarray, "n 3"]:
    """Samples all faces, inner ones included: fast, and accurate enough to compare shapes."""
    mesh = normalised(load_soup(mesh_of(shape, meshes)))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(shape.turn), [0, 1, 0]))
    return surface_points(mesh, POINTS, seed=0)


def _one_sided(tree: KDTree, other: KDTree) -> float:
    """Returns one direction of the Chamfer distance × 1000."""
    distances, _ = tree.query(other.data)
    return float(1000 * np.mean(distances**2))
