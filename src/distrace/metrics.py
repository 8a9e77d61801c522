"""Comparing surfaces, masks and depths."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

if TYPE_CHECKING:
    import trimesh

POINTS = 30_000  # on each mesh


@dataclass(frozen=True)
class Chamfer:
    """Mean squared distances × 1000 between two surfaces, in the frame of the unit sphere."""

    to: float  # from the predicted surface to the true one: surplus surface
    from_: float  # from the true surface to the predicted one: missing surface

    @property
    def sum(self) -> float:
        """Both directions together."""
        return self.to + self.from_


def chamfer(predicted: "trimesh.Trimesh | np.ndarray", truth: "trimesh.Trimesh | np.ndarray", seed: int = 0) -> Chamfer:
    """Returns the Chamfer distance of two meshes (30,000 points on each) or clouds [n, 3]: squared, × 1000.

    Raises `ValueError` for an empty surface.

    >>> print(f"{chamfer(np.zeros((1, 3)), np.array([[0.0, 0.0, 0.1]])).sum:.1f}")
    20.0
    """
    from scipy.spatial import KDTree

    first = _cloud(predicted, seed)
    second = _cloud(truth, seed + 1)
    to, _ = KDTree(second).query(first, workers=-1)
    from_, _ = KDTree(first).query(second, workers=-1)
    return Chamfer(float(1000 * np.mean(to**2)), float(1000 * np.mean(from_**2)))


def surface_points(mesh: "trimesh.Trimesh", count: int, seed: int) -> Float[np.ndarray, "count 3"]:
    """Returns points spread evenly over a mesh."""
    from trimesh.sample import sample_surface

    return np.asarray(sample_surface(mesh, count, seed=seed)[0])


def _cloud(surface: "trimesh.Trimesh | np.ndarray", seed: int) -> Float[np.ndarray, "n 3"]:
    """Returns points of a mesh; a cloud stays as it is."""
    import trimesh

    if isinstance(surface, trimesh.Trimesh):
        if not len(surface.faces):
            raise ValueError("a mesh without faces was given; chamfer needs a surface on both sides")
        return surface_points(surface, POINTS, seed)
    points = np.asarray(surface)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        shape = list(points.shape)
        raise ValueError(f"points of shape {shape} were given; chamfer takes meshes or clouds of shape [n, 3]")
    return points


def iou(first: Bool[Tensor, "*shape"], second: Bool[Tensor, "*shape"]) -> float:
    """Returns the intersection over union of two masks; 1 if both are empty.

    >>> iou(torch.tensor([True, True]), torch.tensor([True, False]))
    0.5
    """
    union = (first | second).sum()
    return float((first & second).sum() / union) if union else 1.0


def depth_errors(depth: Float[Tensor, "*shape"], reference: Float[Tensor, "*shape"]) -> Float[Tensor, "n"]:
    """Returns |depth − reference| at the pixels where both are finite."""
    both = torch.isfinite(depth) & torch.isfinite(reference)
    return (depth[both] - reference[both]).abs()
