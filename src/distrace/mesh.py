"""The surface of a field as triangles."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from distrace.colour_space import to_linear
from distrace.errors import DoubtfulResult
from distrace.fields.base import SDF, check_field, chunked, evaluate_checked, pruned
from distrace.fields.lipschitz import percentile_99, typical_slope
from distrace.files import atomic_write
from distrace.pose import Similarity
from distrace.surface import directions_of_taps

if TYPE_CHECKING:
    import trimesh

CHUNK = 1 << 16  # points evaluated at a time, of a field that does not limit them itself
MAX_RESOLUTION = 2048  # cells along an axis: 32 GiB of values
MAX_ROUNDS = 4  # of meshing again with a larger Lipschitz bound, where the field is steeper than the bound
SLOPE_TOLERANCE = 1.01  # × the bound: a slope up to here does not exceed it
SLOPE_MARGIN = 1.25  # × the measured slope: the next round's bound
LEVELS = 3  # cells are halved this often; only those that can hold the surface are kept
INVERTED = 0.9  # share of points on the ball: a field that is negative at more of them has probably the wrong sign


@dataclass(frozen=True)
class MeshConfig:
    """The grid of `extract_mesh`: `resolution` cells along each axis of the cube around the ball of `radius`.

    Raises `ValueError` for a resolution that is no multiple of 8, or above 2048.
    """

    resolution: int = 256
    radius: float = 1.0  # everything beyond counts as outside: decoders are not trained there
    lipschitz: float = 1.5  # a bound on |∇f|, raised where it is exceeded; it excludes cells without surface
    device: torch.device = torch.device("cpu")

    def __post_init__(self) -> None:
        if not 8 <= self.resolution <= MAX_RESOLUTION or self.resolution % 2**LEVELS:
            raise ValueError(
                f"a resolution of {self.resolution} was given; it must be a multiple of 8, up to {MAX_RESOLUTION}"
            )

    @property
    def width(self) -> float:
        """The width of the finest cells."""
        return 2 * self.radius / self.resolution


@torch.no_grad()
def extract_mesh(sdf: SDF, config: MeshConfig = MeshConfig()) -> "trimesh.Trimesh":
    """Returns the surface of a field, by marching cubes (Lorensen and Cline, SIGGRAPH 1987).

    Only cells that can hold the surface are evaluated. Normals point out. Raises `ValueError` where the field has no
    zero in the cube. Warns `DoubtfulResult` of a field that is NaN at points in the ball, whose mesh may be open, and
    of one that is negative all around the ball.

    >>> from distrace.fields import primitives
    >>> mesh = extract_mesh(primitives.sphere(0.5), MeshConfig(resolution=32))
    >>> print(mesh.is_watertight, f"{mesh.volume:.2f}")
    True 0.52
    """
    import trimesh
    from skimage.measure import marching_cubes

    check_field(sdf)
    field = _Watched(sdf if hasattr(sdf, "pruned") else chunked(sdf, CHUNK), config.radius)
    values_on_ball = field(config.radius * directions_of_taps(torch.empty(0, device=config.device)))
    slope, _ = typical_slope(field, torch.empty(0, device=config.device), config.radius)
    if slope > config.lipschitz:
        config = replace(config, lipschitz=SLOPE_MARGIN * slope)
    grid = _values(field, config)
    for _ in range(MAX_ROUNDS):
        slope = _slope_at_surface(grid, config)
        if slope <= SLOPE_TOLERANCE * config.lipschitz:
            break
        config = replace(config, lipschitz=SLOPE_MARGIN * slope)
        grid = _values(field, config)
    _warn_of_doubts(field, values_on_ball, config)
    evaluated = np.isfinite(grid)
    vertices, faces, _, _ = marching_cubes(np.where(evaluated, grid, 1.0), 0.0, mask=_whole_cells(evaluated))
    return trimesh.Trimesh(vertices * config.width - config.radius, faces, process=False)


def mesh_in_world(mesh: "trimesh.Trimesh", place: Similarity) -> "trimesh.Trimesh":
    """Returns a copy of a mesh of the object's frame in the world, moved in double precision."""
    return mesh.copy().apply_transform(place.T_world_object.double().cpu().numpy())


def save_mesh(path: Path, mesh: "trimesh.Trimesh") -> None:
    """Writes a mesh in the format of the name, PLY, GLB or OBJ, with the colours of its vertices.

    The mesh has sRGB colours of 8 bits a channel. PLY holds them as they are, OBJ as fractions of one, and GLB in
    linear light of 8 bits, as glTF 2.0 has them (section 3.7.2.1): of dark colours it keeps fewer levels.
    """
    from trimesh.visual import ColorVisuals

    kind = path.suffix.removeprefix(".")
    if kind == "glb" and isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind == "vertex":
        colours = _in_linear_light(np.asarray(mesh.visual.vertex_colors))
        mesh = mesh.copy()
        mesh.visual = ColorVisuals(mesh, vertex_colors=colours)
    options = {"header": "distrace", "include_texture": False} if kind == "obj" else {}  # OBJ without a .mtl
    with atomic_write(path) as file:
        mesh.export(file, file_type=kind, **options)


def _in_linear_light(colours: UInt8[np.ndarray, "n 4"]) -> UInt8[np.ndarray, "n 4"]:
    """Returns sRGB colours in linear light (IEC 61966-2-1); the fourth column, the opacity, is linear already."""
    light = to_linear(torch.from_numpy(colours[:, :3] / 255)).numpy()
    return np.hstack([np.rint(255 * light).astype(np.uint8), colours[:, 3:]])


class _Watched:
    """A field that counts the points in the ball at which it is evaluated, and those where it is NaN."""

    def __init__(self, sdf: SDF, radius: float) -> None:
        self.sdf = sdf
        self.radius = radius
        self.evaluations = 0
        self.undefined = 0

    def __call__(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        return self._counted(points, evaluate_checked(self.sdf, points))

    def pruned(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], SDF]:
        """Returns what the function of that name does; the pruned field counts here, too."""
        values, field = pruned(self.sdf, points)
        return self._counted(points, values), lambda near: self._counted(near, evaluate_checked(field, near))

    def _counted(self, points: Float[Tensor, "n 3"], values: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        within = points.norm(dim=-1) <= self.radius
        self.evaluations += int(within.sum())
        self.undefined += int((within & values.isnan()).sum())
        return values

    def __str__(self) -> str:
        points = f"{self.undefined:,} of {self.evaluations:,} points within {self.radius} of the origin"
        return f"the field is NaN at {points}"


def _warn_of_doubts(field: _Watched, values_on_ball: Float[Tensor, "n"], config: MeshConfig) -> None:
    if field.undefined:
        _warn(f"{field}; the mesh may have holes there")
    negative = int((values_on_ball < 0).sum())
    if negative > INVERTED * len(values_on_ball):
        share = f"{negative} of {len(values_on_ball)} points at {config.radius} from the origin"
        _warn(f"the field is negative at {share}, so the mesh is of what surrounds the shape; is its sign inverted?")


def _warn(sentence: str) -> None:
    warnings.warn(sentence, DoubtfulResult, stacklevel=5)  # where `extract_mesh`, which torch decorates, was called


def _values(sdf: _Watched, config: MeshConfig) -> np.ndarray:
    """Returns the field at the corners of cells that can hold the surface; NaN elsewhere."""
    cells, field = _cells_at_surface(sdf, config)
    corners = _corners(cells, config.resolution + 1)
    points = corners.float() * config.width - config.radius
    values = field(points)
    if not ((values < 0).any() and (values > 0).any()):
        if sdf.undefined:
            raise ValueError(f"{sdf}, and has no zero elsewhere: there is no surface to extract")
        raise ValueError(
            f"the field has no zero within {config.radius} of the origin: there is no surface to extract; if"
            f" there is, the field is steeper than {config.lipschitz:.3g} per length: give a larger `lipschitz`"
        )
    grid = np.full([config.resolution + 1] * 3, np.nan, dtype=np.float32)
    grid[tuple(corners.cpu().numpy().T)] = _in_ball(values, points, config).cpu().numpy()
    return grid


def _slope_at_surface(grid: np.ndarray, config: MeshConfig) -> float:
    """Returns the 99th percentile of the field's slopes across its zero, per length."""
    slopes: list[Tensor] = []
    for axis in range(3):
        first, second = (np.moveaxis(grid, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        crossed = (first < 0) != (second < 0)
        change = np.abs(second[crossed] - first[crossed])
        slopes.append(torch.from_numpy(change[np.isfinite(change)]))
    return percentile_99(torch.cat(slopes)) / config.width


def _cells_at_surface(sdf: SDF, config: MeshConfig) -> tuple[Int[Tensor, "n 3"], SDF]:
    """Returns the indices of the finest cells that |f| at the centre cannot exclude, from coarse to fine.

    Also returns a field with the same values near its surface: a cheaper one, if there is.
    """
    coarse = torch.arange(config.resolution >> LEVELS, device=config.device)
    cells = torch.cartesian_prod(coarse, coarse, coarse)
    halves = _offsets(config.device)
    field = sdf
    for level in range(LEVELS, 0, -1):
        width = config.width * 2**level
        centres = (cells + 0.5) * width - config.radius
        values, field = pruned(sdf, centres) if level == 1 else (evaluate_checked(sdf, centres), sdf)
        near = _in_ball(values, centres, config).abs() <= config.lipschitz * width * 3**0.5 / 2
        cells = (2 * cells[near][:, None] + halves).reshape(-1, 3)
    return cells, field


def _in_ball(values: Float[Tensor, "n"], points: Float[Tensor, "n 3"], config: MeshConfig) -> Float[Tensor, "n"]:
    """Returns the field of the intersection of shape and ball; the ball's is scaled to the same slope."""
    return values.maximum(config.lipschitz * (points.norm(dim=1) - config.radius))


def _corners(cells: Int[Tensor, "n 3"], along: int) -> Int[Tensor, "m 3"]:
    """Returns each corner of the cells once; `along` is their number along an axis.

    Corners are compared by one number each, as comparing rows is slow.
    """
    x, y, z = (cells[:, None] + _offsets(cells.device)).reshape(-1, 3).T
    numbers = torch.unique((x * along + y) * along + z)
    return torch.stack([numbers // along**2, numbers // along % along, numbers % along], dim=1)


def _offsets(device: torch.device) -> Int[Tensor, "8 3"]:
    return torch.cartesian_prod(*[torch.arange(2, device=device)] * 3)


def _whole_cells(evaluated: np.ndarray) -> np.ndarray:
    """Returns the cells whose eight corners are evaluated, marked at the corner that scikit-image reads."""
    whole = evaluated
    for axis in range(3):
        layers = np.moveaxis(whole, axis, 0)
        whole = np.moveaxis(layers[1:] & layers[:-1], 0, axis)
    return np.pad(whole, ((1, 0),) * 3)
