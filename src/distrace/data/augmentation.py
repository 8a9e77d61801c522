"""Warped variants of a shape: a random monotonic map of each axis changes the sizes of its parts.

Boxes stay boxes, and symmetric shapes stay symmetric. Distances change, so variants are sampled like meshes.
"""

import numpy as np
from jaxtyping import Float

from distrace.data.solid import Solid, normalised_frame
from distrace.metrics import surface_points

MAX_STRETCH = 0.2  # an axis is stretched by up to e to this …
LOCAL_STRETCH = 0.25  # … and parts of it by e to a random function of about this size
WAVES = 3  # half waves along the axis that the function is made of
MAX_EDGE = 0.1  # longer edges are split first, so that they can bend
MAX_SYMMETRY_ERROR = 2e-5  # mean squared distance of a shape to its mirror image up to which it is symmetric
KNOTS = np.linspace(-1, 1, 201)


def lopsided(solid: Solid, axis: int = 0, count: int = 2000) -> bool:
    """Whether the mirror image in an axis is another shape."""
    points = surface_points(solid.surface, count, seed=0)
    points[:, axis] *= -1
    return bool(np.mean(solid.distance(points) ** 2) > MAX_SYMMETRY_ERROR)


def warped(solid: Solid, random: np.random.Generator) -> Solid:
    """A random variant in the unit sphere; one in two is mirrored in x."""
    import trimesh
    from trimesh.remesh import subdivide_to_size

    mirrored = np.array([1 - 2 * random.integers(2), 1, 1])
    maps = [_axis_map(random, even=axis != 1 and not lopsided(solid, axis)) for axis in range(3)]

    def mapped(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
        vertices, faces, *_ = subdivide_to_size(mesh.vertices, mesh.faces, MAX_EDGE, max_iter=20)
        moved = np.stack([np.interp(vertices[:, axis], KNOTS, maps[axis]) for axis in range(3)], axis=1) * mirrored
        return trimesh.Trimesh(moved, faces if mirrored[0] > 0 else faces[:, ::-1], process=False)

    soup = mapped(solid.soup)
    surface = mapped(solid.surface)
    middle, scale = normalised_frame(soup)
    for mesh in (soup, surface):
        mesh.vertices = (mesh.vertices - middle) * scale
    return Solid(soup, surface)


def _axis_map(random: np.random.Generator, even: bool) -> Float[np.ndarray, "knots"]:
    """The new coordinates of an axis's knots: the integral of a positive random density."""
    from scipy.integrate import cumulative_trapezoid

    waves = np.arange(1, WAVES + 1)
    phases = np.pi * waves * (KNOTS[:, None] + 1) / 2 + random.uniform(0, 2 * np.pi, WAVES)
    logarithm = np.cos(phases) @ (random.normal(size=WAVES) * LOCAL_STRETCH / np.sqrt(waves))
    if even:
        logarithm = (logarithm + logarithm[::-1]) / 2
    density = np.exp(logarithm + random.uniform(-MAX_STRETCH, MAX_STRETCH))
    moved = cumulative_trapezoid(density, KNOTS, initial=0)
    return moved - moved[len(KNOTS) // 2]
