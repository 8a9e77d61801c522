"""Near-variants among shapes: of each held-out one the nearest that was trained on, and all pairs that are close."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

from distrace.data.shapes import Shape
from distrace.data.solid import load_soup, mesh_of, normalised
from distrace.metrics import surface_points

POINTS = 4000  # of each shape


@dataclass(frozen=True)
class Near:
    """Two shapes, and how far apart they are."""

    shape: str
    split: str
    design: str
    nearest: str  # of another design
    nearest_split: str
    chamfer: float
    nearest_trained: str  # for a held-out shape, of those trained on
    chamfer_trained: float


def used(shapes: list[Shape]) -> list[Shape]:
    """Those on either side."""
    return [shape for shape in shapes if shape.split != "out"]


def nearest_rows(shapes: list[Shape], meshes: Path, tell: Callable[[str], None]) -> list[Near]:
    """One row for each shape, the closest pairs first."""
    trees = []
    for shape in shapes:
        trees.append(KDTree(_points(shape, meshes)))
        tell(shape.name)
    apart = np.array([[_apart(one, other) for other in trees] for one in trees])
    apart = apart + apart.T
    return sorted((_near(k, shapes, apart) for k in range(len(shapes))), key=lambda near: near.chamfer)


def _near(k: int, shapes: list[Shape], apart: np.ndarray) -> Near:
    other = np.array([shape.design != shapes[k].design for shape in shapes])
    trained = other & np.array([shape.split == "train" for shape in shapes])
    first, learnt = (int(np.where(which, apart[k], np.inf).argmin()) for which in (other, trained))
    near, known = shapes[first], shapes[learnt]
    shape = shapes[k]
    return Near(
        shape.name,
        shape.split,
        shape.design,
        near.name,
        near.split,
        round(float(apart[k, first]), 3),
        known.name,
        round(float(apart[k, learnt]), 3),
    )


def _points(shape: Shape, meshes: Path) -> Float[np.ndarray, "n 3"]:
    """Of all faces: good enough to tell shapes apart, and quick."""
    mesh = normalised(load_soup(mesh_of(shape, meshes)))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(shape.turn), [0, 1, 0]))
    return surface_points(mesh, POINTS, seed=0)


def _apart(one: KDTree, other: KDTree) -> float:
    """One direction of the Chamfer distance × 1000."""
    distances, _ = one.query(other.data)
    return float(1000 * np.mean(distances**2))
