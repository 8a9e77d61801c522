"""The surface of a field as triangles."""

import math
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.errors import DoubtfulResult
from distrace.fields.base import SDF, asked, check_field, chunked, narrowed
from distrace.fields.lipschitz import steep, typical_slope

if TYPE_CHECKING:
    import trimesh

AT_ONCE = 1 << 16  # points, of a field that does not limit them itself
MOST = 2048  # cells along an axis: 32 GiB of values
ROUNDS = 4  # at most, in which a field that is steeper than told is meshed again: …
ALMOST = 1.01  # × as steep as told is not steeper …
STEEPER = 1.25  # … for as much more than was found
LEVELS = 3  # cells are halved this often, and only those kept that can hold the surface
AROUND = 512  # points of the ball's surface, at which a field is positive …
INVERTED = 0.9  # … or, where it is negative at more than this share, probably inverted


@dataclass(frozen=True)
class MeshConfig:
    """A grid of `resolution` cells (a multiple of 8) along each axis of the cube around the ball of this radius."""

    resolution: int = 256
    radius: float = 1.0  # beyond, where decoders were never trained and rays are not marched, is outside
    steepest: float = 1.5  # |∇f|, unless more is found: cells farther from zero over half a diagonal are left out
    device: torch.device = torch.device("cpu")

    def __post_init__(self) -> None:
        if not 8 <= self.resolution <= MOST or self.resolution % 2**LEVELS:
            raise ValueError(f"a resolution of {self.resolution} was given; it must be a multiple of 8, up to {MOST}")

    @property
    def width(self) -> float:
        """Of the finest cells."""
        return 2 * self.radius / self.resolution


@torch.no_grad()
def extract_mesh(sdf: SDF, config: MeshConfig = MeshConfig()) -> "trimesh.Trimesh":
    """Marching cubes (Lorensen and Cline, SIGGRAPH 1987) on the cells of a grid that can hold the surface.

    Normals point out. Raises `ValueError` where the field has no zero in the cube. Warns by `DoubtfulResult` of a field
    that is NaN at points in the ball, whose mesh may be open, and of one that is negative all around the ball.
    """
    import trimesh
    from skimage.measure import marching_cubes

    check_field(sdf)
    sdf = watched = _Watched(sdf if hasattr(sdf, "narrowed") else chunked(sdf, AT_ONCE), config.radius)
    around = asked(sdf, _around(config))
    slope, _ = typical_slope(sdf, torch.empty(0, device=config.device), config.radius)
    if slope > config.steepest:
        config = replace(config, steepest=STEEPER * slope)
    grid = _values(sdf, config)
    for _ in range(ROUNDS):
        found = _steepness(grid, config)
        if found <= ALMOST * config.steepest:
            break
        config = replace(config, steepest=STEEPER * found)
        grid = _values(sdf, config)
    _warn_of_doubts(watched, around, config)
    known = np.isfinite(grid)
    vertices, faces, _, _ = marching_cubes(np.where(known, grid, 1.0), 0.0, mask=_whole_cells(known))
    return trimesh.Trimesh(vertices * config.width - config.radius, faces, process=False)


class _Watched:
    """The same field, counting the points in the ball that it was evaluated at, and those where it gave NaN."""

    def __init__(self, sdf: SDF, radius: float) -> None:
        self.sdf, self.radius = sdf, radius
        self.evaluations, self.undefined = 0, 0

    def __call__(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        return self._seen(points, asked(self.sdf, points))

    def narrowed(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], SDF]:
        """As the function of that name; what it returns is watched, too."""
        values, near = narrowed(self.sdf, points)
        return self._seen(points, values), lambda others: self._seen(others, asked(near, others))

    def nan(self) -> str:
        """Where the field was NaN, in words; empty where it never was."""
        points = f"{self.undefined:,} of {self.evaluations:,} points within {self.radius} of the origin"
        return f"the field is NaN at {points}" if self.undefined else ""

    def _seen(self, points: Float[Tensor, "n 3"], values: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        within = points.norm(dim=-1) <= self.radius
        self.evaluations += int(within.sum())
        self.undefined += int((within & values.isnan()).sum())
        return values


def _around(config: MeshConfig) -> Float[Tensor, "n 3"]:
    """Points spread evenly over the surface of the ball, by the golden angle."""
    number = torch.arange(AROUND, device=config.device) + 0.5
    height, angle = 1 - 2 * number / AROUND, math.pi * (3 - 5**0.5) * number
    across = (1 - height**2).sqrt()
    return config.radius * torch.stack([across * angle.cos(), height, across * angle.sin()], dim=1)


def _warn_of_doubts(watched: _Watched, around: Float[Tensor, "n"], config: MeshConfig) -> None:
    if watched.undefined:
        _warn(f"{watched.nan()}; the mesh may have holes there")
    if (negative := int((around < 0).sum())) > INVERTED * AROUND:
        share = f"{negative} of {AROUND} points at {config.radius} from the origin"
        _warn(f"the field is negative at {share}, so the mesh is of what surrounds the shape; is its sign inverted?")


def _warn(sentence: str) -> None:
    warnings.warn(sentence, DoubtfulResult, stacklevel=5)  # where `extract_mesh`, which torch decorates, was called


def _values(sdf: _Watched, config: MeshConfig) -> np.ndarray:
    """At the corners of the cells that can hold the surface; NaN elsewhere."""
    cells, near = _cells_at_surface(sdf, config)
    corners = _corners(cells, config.resolution + 1)
    points = corners.float() * config.width - config.radius
    found = near(points)
    if not ((found < 0).any() and (found > 0).any()):
        if sdf.undefined:
            raise ValueError(f"{sdf.nan()}, and has no zero elsewhere: there is no surface to extract")
        raise ValueError(
            f"the field has no zero within {config.radius} of the origin: there is no surface to extract; if"
            f" there is, the field is steeper than {config.steepest:.3g} per length: say how steep by `steepest`"
        )
    grid = np.full([config.resolution + 1] * 3, np.nan, dtype=np.float32)
    grid[tuple(corners.cpu().numpy().T)] = _in_ball(found, points, config).cpu().numpy()
    return grid


def _steepness(grid: np.ndarray, config: MeshConfig) -> float:
    """What 99 of 100 differences of the field across its zero stay below, per length."""
    slopes = []
    for axis in range(3):
        first, second = (np.moveaxis(grid, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        crossed = (first < 0) != (second < 0)
        apart = np.abs(second[crossed] - first[crossed])
        slopes.append(torch.from_numpy(apart[np.isfinite(apart)]))
    return steep(torch.cat(slopes)) / config.width


def _cells_at_surface(sdf: SDF, config: MeshConfig) -> tuple[Int[Tensor, "n 3"], SDF]:
    """Indices of the finest cells, found by halving those of a coarse grid that |f| at the centre cannot exclude.

    With them the same field, where it can be cheaper near its surface.
    """
    coarse = torch.arange(config.resolution >> LEVELS, device=config.device)
    cells, halves = torch.cartesian_prod(coarse, coarse, coarse), _offsets(config.device)
    for level in range(LEVELS, 0, -1):
        width = config.width * 2**level
        centres = (cells + 0.5) * width - config.radius
        values, field = narrowed(sdf, centres) if level == 1 else (asked(sdf, centres), sdf)
        near = _in_ball(values, centres, config).abs() <= config.steepest * width * 3**0.5 / 2
        cells = (2 * cells[near][:, None] + halves).reshape(-1, 3)
    return cells, field


def _in_ball(values: Float[Tensor, "n"], points: Float[Tensor, "n 3"], config: MeshConfig) -> Float[Tensor, "n"]:
    """What is common to the shape and the ball, both as steep."""
    return values.maximum(config.steepest * (points.norm(dim=1) - config.radius))


def _corners(cells: Int[Tensor, "n 3"], along: int) -> Int[Tensor, "m 3"]:
    """Each corner of the cells once; `along` is how many an axis has. By one number each: rows are slow to compare."""
    x, y, z = (cells[:, None] + _offsets(cells.device)).reshape(-1, 3).T
    numbers = torch.unique((x * along + y) * along + z)
    return torch.stack([numbers // along**2, numbers // along % along, numbers % along], dim=1)


def _offsets(device: torch.device) -> Int[Tensor, "8 3"]:
    return torch.cartesian_prod(*[torch.arange(2, device=device)] * 3)


def _whole_cells(known: np.ndarray) -> np.ndarray:
    """Cells whose eight corners are known, marked at the corner that scikit-image reads them by."""
    whole = known.copy()
    for axis in range(3):
        shifted = np.zeros_like(whole)
        inner = [slice(None)] * 3
        inner[axis] = slice(1, None)
        before = [slice(None)] * 3
        before[axis] = slice(None, -1)
        shifted[tuple(inner)] = whole[tuple(inner)] & whole[tuple(before)]
        whole = shifted
    return whole
