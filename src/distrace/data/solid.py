"""The solid inside a triangle soup, and the part of the soup that bounds it.

Meshes that people draw are seldom watertight, and much of their area lies inside other parts: cushions pushed into
frames, legs through seats. The solid is where the winding number is at least one half (Jacobson et al., SIGGRAPH 2013;
Barill et al., SIGGRAPH 2018); its surface is the part of the soup across which that changes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from distrace.data.mesh_files import load_soup
from distrace.errors import error_context
from distrace.optional import require

if TYPE_CHECKING:
    import trimesh

RADIUS = 1 / 1.03  # of the largest vertex, as DeepSDF's preprocessing has it (Park et al. 2019, supplementary B)
OFFSET = 3e-4  # distance from a face at which its two sides are tested
TEST_SPACING = 0.02  # between the test points of one face
MIN_VOLUME = 1e-9  # of a closed part that has an inside
MAX_OPEN_SHARE = 0.15  # of a part's area: larger holes make it a sheet
PURPOSE = "telling a mesh's inside from its outside"  # libigl's winding numbers
SMALLEST = 0.01  # faces partly inside are split until their edges are this short


@dataclass(frozen=True)
class Solid:
    """A solid in the unit sphere: every face it came with, and its outer surface with normals pointing out."""

    soup: "trimesh.Trimesh"
    surface: "trimesh.Trimesh"

    def winding(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        return _winding(self.soup, points)

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        return _inside(self.winding(points))

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Distance to the outer surface, negative inside."""
        return np.where(self.contains(points), -1.0, 1.0) * self.apart(points)

    def apart(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Distance to the outer surface, from either side: its sign costs winding numbers."""
        require(PURPOSE, "igl")
        import igl

        surface = self.surface
        squared, _, _ = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces.astype(np.int64))
        return np.sqrt(squared)


def load_solid(path: Path) -> Solid:
    """The solid of a mesh file, centred and scaled into the unit sphere.

    Raises `ValueError` for a file that cannot be read, or that bounds nothing.
    """
    soup = load_oriented(path).soup
    surface = outer_surface(soup)
    if surface.area < 0.05 * soup.area:
        raise ValueError(f"{path} bounds no solid: only {surface.area / soup.area:.0%} of its faces have an inside")
    return Solid(soup, surface)


def load_oriented(path: Path) -> Solid:
    """The solid of a mesh file as `load_solid` gives it, but with all faces as its surface: much faster.

    Raises `ValueError` for a file that cannot be read.
    """
    with error_context(f"{path} cannot be read as a triangle mesh; give an OBJ, PLY, STL, OFF, GLB or AC file", path):
        soup = oriented(normalised(load_soup(path)))
    return Solid(soup, soup)


def turned(solid: Solid, degrees: float) -> Solid:
    """The solid rotated about the y axis."""
    matrix = turn_matrix(degrees)
    return Solid(solid.soup.copy().apply_transform(matrix), solid.surface.copy().apply_transform(matrix))


def turn_matrix(degrees: float) -> Float[np.ndarray, "4 4"]:
    """The rotation about the y axis."""
    from trimesh.transformations import rotation_matrix

    return np.asarray(rotation_matrix(np.radians(degrees), [0, 1, 0]))


def normalised(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """Centred on its bounding box and scaled so that the farthest vertex lies at `RADIUS`."""
    import trimesh

    middle, scale = normalised_frame(mesh)
    scaled = trimesh.Trimesh((mesh.vertices - middle) * scale, mesh.faces, process=False)
    scaled.update_faces(scaled.area_faces > 1e-14)
    if not len(scaled.faces):
        raise ValueError("none of its faces has an area")
    return scaled


def normalised_frame(mesh: "trimesh.Trimesh") -> tuple[np.ndarray, float]:
    """The middle of the bounding box, and what scales the farthest vertex to `RADIUS`."""
    used = np.asarray(mesh.vertices, dtype=np.float64)[np.unique(mesh.faces)]
    if not len(used) or not np.isfinite(used).all():
        raise ValueError("the mesh has no faces, or vertices that are not finite")
    middle = (used.min(0) + used.max(0)) / 2
    return middle, RADIUS / max(np.linalg.norm(used - middle, axis=1).max(), np.finfo(np.float64).tiny)


def oriented(soup: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """The soup with its closed parts facing outwards: where parts overlap, winding numbers of both signs cancel.

    A closed part that faces inwards and lies within others stays as it is: it is a cavity.
    """
    import trimesh

    part, volume, closed = _parts(soup)
    faces = np.array(soup.faces)
    if volume.sum() < 0:
        faces = faces[:, ::-1]
        volume = -volume
    inwards = (closed & (volume < -MIN_VOLUME))[part]
    mesh = trimesh.Trimesh(soup.vertices, faces, process=False)
    if inwards.any():
        outside = mesh.triangles_center[inwards] - OFFSET * mesh.face_normals[inwards]
        within = np.bincount(part[inwards], _winding(mesh, outside) > 0.5, len(volume))
        cavity = within > 0.9 * np.bincount(part[inwards], minlength=len(volume))
        inwards &= ~cavity[part]
        faces[inwards] = faces[inwards][:, ::-1]
        mesh = trimesh.Trimesh(soup.vertices, faces, process=False)
    return mesh


def _parts(soup: "trimesh.Trimesh") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The number of each face's connected part; of each part its signed volume, and whether it is closed but for holes.

    The area vectors of a closed surface add up to zero, those of a sheet to its area.
    """
    from trimesh.graph import connected_component_labels

    merged = soup.copy()
    merged.merge_vertices()
    part = connected_component_labels(merged.face_adjacency, node_count=len(merged.faces))
    area = np.bincount(part, soup.area_faces)

    def integral(values: np.ndarray) -> np.ndarray:
        weighted = values * soup.area_faces[:, None]
        return np.stack([np.bincount(part, column) for column in weighted.T], axis=1)

    centre = integral(soup.triangles_center) / area[:, None]
    heights = ((soup.triangles_center - centre[part]) * soup.face_normals).sum(1)
    volume = np.bincount(part, heights * soup.area_faces / 3)
    return part, volume, np.linalg.norm(integral(soup.face_normals), axis=1) < MAX_OPEN_SHARE * area


def first_met(
    mesh: "trimesh.Trimesh", origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Distance along each ray to the mesh, by Embree; `inf` where a ray misses it."""
    require("casting rays at meshes", "embreex")
    cast: Any = mesh.ray.intersects_location
    points, rays, _ = cast(origins, directions, multiple_hits=False)
    distance = np.full(len(origins), np.inf)
    distance[rays] = np.linalg.norm(points - origins[rays], axis=1)
    return distance


def outer_surface(soup: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """The faces that have the solid on exactly one side, turned outwards; faces half buried are split first."""
    import trimesh

    kept = []
    triangles = soup.triangles.view(np.ndarray)
    while len(triangles):
        share, outward = _exposure(soup, triangles)
        small = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max(1) < SMALLEST
        keep = np.where(small, share > 0.5, share == 1)
        kept.append(np.where(outward[keep, None, None], triangles[keep], triangles[keep][:, ::-1]))
        triangles = _quartered(triangles[(share > 0) & (share < 1) & ~small])
    corners = np.concatenate(kept).reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def bounding(soup: "trimesh.Trimesh") -> Bool[np.ndarray, "faces"]:
    """Which faces have the solid on exactly one side, at least in part: neither buried faces nor loose sheets."""
    return _exposure(soup, soup.triangles.view(np.ndarray))[0] > 0


def _exposure(soup: "trimesh.Trimesh", triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each triangle, the share of test points with the solid on one side only, and whether its normal points out."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    doubled_area = np.linalg.norm(cross, axis=1)
    tests = np.clip(np.ceil(doubled_area / 2 / TEST_SPACING**2), 3, 500).astype(int)
    face = np.repeat(np.arange(len(triangles)), tests)
    points = np.einsum("nk,nkd->nd", _spread(tests), triangles[face])
    normals = (cross / doubled_area[:, None])[face]
    front = _inside(_winding(soup, points + OFFSET * normals))
    back = _inside(_winding(soup, points - OFFSET * normals))
    share = np.bincount(face, front != back, len(triangles)) / tests
    outward = np.bincount(face, back.astype(int) - front.astype(int), len(triangles)) >= 0
    return share, outward


def _spread(tests: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Barycentric coordinates of evenly spread points: the R2 sequence (Roberts 2018), folded into each triangle."""
    index = np.concatenate([np.arange(n) for n in tests])
    u = (index * 0.7548776662) % 1 * 0.98 + 0.01
    v = (index * 0.5698402910 + 0.3) % 1 * 0.98 + 0.01
    fold = u + v > 1
    u = np.where(fold, 1 - u, u)
    v = np.where(fold, 1 - v, v)
    return np.stack([1 - u - v, u, v], axis=1)


def _quartered(triangles: np.ndarray) -> np.ndarray:
    from trimesh.remesh import subdivide

    corners = triangles.reshape(-1, 3)
    vertices, faces, *_ = subdivide(corners, np.arange(len(corners)).reshape(-1, 3))
    return vertices[faces]


def _winding(soup: "trimesh.Trimesh", points: np.ndarray) -> np.ndarray:
    require(PURPOSE, "igl")
    import igl

    vertices = np.asarray(soup.vertices, np.float64)
    faces = np.asarray(soup.faces, np.int64)
    return np.asarray(igl.fast_winding_number(vertices, faces, np.ascontiguousarray(points, np.float64)))


def _inside(winding: np.ndarray) -> np.ndarray:
    return np.abs(winding) > 0.5  # the absolute value: some meshes are drawn inside out
