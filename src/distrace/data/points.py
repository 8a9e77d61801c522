"""Sets of points: their radius, their noise, and which of them are one object's."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

if TYPE_CHECKING:
    from distrace.data.up import Floor

LEAST_POINTS = 20
MOST_POINTS = 20_000
RADIUS_SHARE = 0.8  # of the points are surely the object's: they tell its radius, …
RADIUS_FACTOR = 1.25  # … which is this × their largest distance from the median
NEIGHBOURS = 16  # of a point, which tell the noise
DENSE = 1000  # points: fewer lie so far apart that the shape's bends look like noise
CELLS = 64  # along the object, at most: pieces of it touch in such cells, …
SPACING = 3.0  # … which are at least so many distances of neighbouring points wide
PIECE_SHARE = 0.2  # of the largest piece's points: so large a piece is another part of the object
PIECE_GAP = 0.05  # of the length of these parts: a small piece that near to them is the object's, too


def radius_of(points: Float[Tensor, "n 3"]) -> float:
    away = (points - points.median(0).values).norm(dim=-1)
    return RADIUS_FACTOR * float(away.quantile(RADIUS_SHARE))


def random_subset(rows: Tensor, most: int = MOST_POINTS, seed: int = 0) -> Tensor:
    """Returns all rows, or `most` of them, drawn at random."""
    if len(rows) <= most:
        return rows
    return rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))[:most]]


def noise_of(points: Float[Tensor, "n 3"]) -> float:
    """The median distance (root mean square) of points' neighbours from a plane; 0 of sparse points."""
    from scipy.spatial import KDTree

    if len(points) < DENSE:
        return 0.0
    chosen = points[:: max(len(points) // 1000, 1)].double().numpy()
    _, near = KDTree(points.double().numpy()).query(chosen, NEIGHBOURS)
    around = points.double().numpy()[near]
    flatness = np.linalg.svd(around - around.mean(1, keepdims=True), compute_uv=False)[:, -1]
    return float(np.median(flatness) / np.sqrt(NEIGHBOURS))


def object_points(points: Float[Tensor, "n 3"], floor: "Floor | None", share: float = PIECE_SHARE) -> Bool[Tensor, "n"]:
    """Returns which points belong to the largest pieces and what is near them; the floor's do not."""
    from scipy.spatial import KDTree

    kept = torch.ones(len(points), dtype=torch.bool)
    if floor is not None:
        kept = points @ floor.normal - floor.height > 1.5 * floor.thickness
    if kept.sum() < LEAST_POINTS:
        return torch.ones_like(kept)
    candidates = points[kept]
    pieces = _pieces(candidates)
    counts = pieces.bincount()
    is_main = (counts >= share * counts.max())[pieces]
    main = candidates[is_main]
    gap = PIECE_GAP * float((main.amax(0) - main.amin(0)).max())
    away = torch.zeros(len(candidates), dtype=torch.float64)
    distances, _ = KDTree(main.double().numpy()).query(candidates[~is_main].double().numpy())
    away[~is_main] = torch.from_numpy(distances)
    nearest = torch.full((len(counts),), torch.inf, dtype=torch.float64)
    nearest.scatter_reduce_(0, pieces, away, "amin")
    kept[kept.clone()] = nearest[pieces] <= gap
    return kept


def _pieces(points: Float[Tensor, "n 3"]) -> Tensor:
    """The number of each point's piece: pieces are connected cells of a grid."""
    from scipy.ndimage import label
    from scipy.spatial import KDTree

    low = points.amin(0)
    some = points[:: max(len(points) // 1000, 1)].double().numpy()
    apart, _ = KDTree(points.double().numpy()).query(some, 2)
    width = max(float((points - low).max()) / CELLS, SPACING * float(np.median(apart[:, 1]))) or 1.0
    cell = ((points - low) / width).long()
    occupied = np.zeros((CELLS + 2,) * 3, dtype=bool)
    occupied[tuple(cell.T.numpy())] = True
    labels: Any = label(occupied, np.ones((3, 3, 3)))
    return torch.from_numpy(labels[0][tuple(cell.T.numpy())]).long()
