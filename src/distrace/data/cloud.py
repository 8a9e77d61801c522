"""Points of a surface, as a scanner gives them: no camera, perhaps normals."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.checks import MAX_MEDIAN_RADIUS
from distrace.data.mesh_files import load_geometry
from distrace.data.observation import View
from distrace.data.pcd import load_pcd
from distrace.data.points import random_subset
from distrace.errors import DoubtfulResult, error_context


@dataclass(frozen=True)
class Cloud:
    """Surface points in the frame of the unit sphere; normals, if known, point out of the shape."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"] | None = None

    def to(self, device: torch.device | str) -> "Cloud":
        return Cloud(self.points.to(device), None if self.normals is None else self.normals.to(device))

    def sparse(self, count: int, seed: int = 0) -> "Cloud":
        """Returns at most `count` of the points, drawn at random."""
        chosen = random_subset(torch.arange(len(self.points)), count, seed)
        return Cloud(self.points[chosen], None if self.normals is None else self.normals[chosen])

    def seen_from(self, camera: Camera) -> View:
        """Returns the points as depths of the pixels that they fall into, the nearest of each; none hides another's."""
        return View(camera, camera.nearest_points(self.points)[1])


def load_cloud(path: Path) -> Cloud:
    """Reads points, or a mesh's vertices, in the frame of the unit sphere, and their normals where the file has them.

    Points that are not finite, or whose normals have no direction, are dropped, and a `DoubtfulResult` says how many.
    Raises `ValueError`, in one sentence, for what holds no point or makes no sense.
    """
    points, normals = _read(path, "give a PLY in the frame of the unit sphere")
    usable = _finite(path, points)
    if normals is not None:
        directed = normals.any(-1)
        if (usable & directed).sum() < usable.sum() / 2:
            normals = None
            _warn(f"{path}: most of its normals have no direction, and none is used")
        else:
            usable &= directed
    if not usable.all():
        _warn(f"{path}: {(~usable).sum()} points that are not finite, or whose normals are not, were dropped")
    cloud = Cloud(
        torch.from_numpy(points[usable]).float(), None if normals is None else torch.from_numpy(normals[usable]).float()
    )
    away = cloud.points.norm(dim=-1).median().item()
    if away > MAX_MEDIAN_RADIUS or away < MAX_MEDIAN_RADIUS / 100:
        raise ValueError(
            f"{path}: its points lie {away:.3g} from the origin in the median, but the shape must be in the unit sphere"
            " around the origin: centre it and divide by its largest radius"
        )
    return cloud


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Returns the finite points of a cloud in any frame and unit: PLY, PCD, XYZ, or the vertices of a mesh.

    A `DoubtfulResult` says how many were dropped. Raises `ValueError` for a file without any.
    """
    points, _ = _read(path, "give a PLY, PCD or XYZ file")
    usable = _finite(path, points)
    if not usable.all():
        _warn(f"{path}: {(~usable).sum()} points that are not finite were dropped")
    return points[usable]


def _read(path: Path, advice: str) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"] | None]:
    with error_context(f"{path} cannot be read as a cloud of points; {advice}", path):
        if path.suffix.lower() == ".pcd":
            columns = load_pcd(path)
            return np.stack([columns[axis] for axis in "xyz"], axis=1), None
        loaded = load_geometry(path)
        return np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64), _normals(loaded)


def _finite(path: Path, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    with np.errstate(over="ignore"):  # what is too large for float32 becomes inf
        usable = np.asarray(np.isfinite(points.astype(np.float32)).all(1))
    if not usable.any():
        raise ValueError(f"{path}: it has {len(points)} points, and none that is finite")
    return usable


def _normals(loaded: Any) -> Float[np.ndarray, "n 3"] | None:
    """Returns those of the file, of unit length, or zero where they have no direction; a mesh's are not made up."""
    vertices = loaded.metadata.get("_ply_raw", {}).get("vertex", {})
    names = ("nx", "ny", "nz")
    if not set(names) <= set(vertices.get("properties", ())):
        return None
    columns = [np.asarray(vertices["data"][name], np.float64).reshape(-1) for name in names]
    normals = np.stack(columns, axis=-1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = (length > 1e-6) & np.isfinite(length)
    return np.where(known, normals, 0.0) / np.where(known, length, 1.0)


def _warn(sentence: str) -> None:
    warnings.warn(sentence, DoubtfulResult, stacklevel=3)
