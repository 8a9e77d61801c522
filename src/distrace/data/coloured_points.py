"""Points on the surface of a mesh with its appearance: what a colour decoder learns from."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from distrace.data.patches import Patch, in_unit_sphere, load_patches
from distrace.data.shapes import Shape
from distrace.data.solid import OFFSET, Solid, load_oriented, turned
from distrace.files import save_arrays


@dataclass(frozen=True)
class ColouredPoints:
    """Points of an outer surface in the unit sphere, with normals and colours."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]  # of unit length, outwards
    colours: Float[np.ndarray, "n 3"]  # sRGB, 0 to 1
    patch: Int[np.ndarray, "n"]  # which of the mesh's materials

    def save(self, path: Path) -> None:
        save_arrays(path, {name: torch.from_numpy(array) for name, array in vars(self).items()})

    @staticmethod
    def load(path: Path) -> "ColouredPoints":
        with np.load(path, allow_pickle=False) as stored:
            return ColouredPoints(stored["points"], stored["normals"], stored["colours"], stored["patch"])


def coloured_points(path: Path, turn: float, count: int, seed: int = 0) -> ColouredPoints:
    """Returns points evenly spread on the outer surface of a mesh file, turned by degrees about y.

    Fewer than `count` are left where parts of the mesh lie within others. Raises `ValueError` for a file that cannot be
    read, or that bounds no solid.
    """
    solid = turned(load_oriented(path), turn)
    found = _spread(in_unit_sphere(load_patches(path), turn), solid, count, np.random.default_rng(seed))
    if not len(found.points):
        raise ValueError(f"{path} bounds no solid: none of its faces has an inside")
    return found


def _spread(patches: Sequence[Patch], solid: Solid, count: int, random: np.random.Generator) -> ColouredPoints:
    corners = np.concatenate([patch.corners for patch in patches])
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled_area = np.linalg.norm(cross, axis=1)
    triangle = random.choice(len(corners), count, p=doubled_area / doubled_area.sum())
    weights = random.dirichlet(np.ones(3), count)
    points = np.einsum("nk,nkd->nd", weights, corners[triangle])
    normals = cross[triangle] / doubled_area[triangle, None]  # faces without area are not chosen

    sizes = [len(patch.corners) for patch in patches]
    of_patch = np.repeat(np.arange(len(patches)), sizes)[triangle]
    first = np.cumsum([0, *sizes[:-1]])
    colours = np.empty((count, 3))
    for number, patch in enumerate(patches):
        chosen = of_patch == number
        colours[chosen] = patch.colours_at(triangle[chosen] - first[number], weights[chosen])

    front = solid.contains(points + OFFSET * normals)
    back = solid.contains(points - OFFSET * normals)
    outwards = np.where(front, -1.0, 1.0)[:, None] * normals
    outer = front != back
    return ColouredPoints(
        points[outer].astype(np.float32),
        outwards[outer].astype(np.float32),
        colours[outer].astype(np.float32),
        of_patch[outer],
    )


@dataclass(frozen=True)
class ColourJob:
    """One mesh to take coloured points from."""

    name: str
    mesh: Path
    turn: float  # degrees about y
    out: Path
    count: int

    def run(self) -> tuple["ColourJob", str]:
        """Writes the points, unless they are there; returns why there are none, or an empty string."""
        if self.out.is_file():
            return self, ""
        try:
            points = coloured_points(self.mesh, self.turn, self.count, zlib.crc32(self.name.encode()))
        except ValueError as error:
            return self, str(error)
        points.save(self.out)
        return self, ""


def colour_jobs(shapes: Sequence[Shape], meshes: Path, out: Path, count: int) -> list[ColourJob]:
    """Returns a job for each shape."""
    return [ColourJob(each.name, meshes / each.path, each.turn, out / f"{each.name}.npz", count) for each in shapes]
