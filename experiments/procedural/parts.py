"""Parts of furniture: rounded blocks and rods, each the convex hull of its points.

Sizes are in metres, y is up, and fronts look to +z.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import trimesh
from jaxtyping import Float

Part = Float[np.ndarray, "_ 3"]
"""Points whose convex hull is the part."""

Point = tuple[float, float, float]
Vector = Sequence[float] | Float[np.ndarray, "3"]

BALL = trimesh.creation.icosphere(subdivisions=2).vertices.view(np.ndarray)
OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)


def block(low: Vector, high: Vector, radius: float) -> Part:
    """Returns a box with rounded edges."""
    low = np.asarray(low, np.float64)
    high = np.asarray(high, np.float64)
    radius = min(radius, 0.499 * float((high - low).min()))
    middle = (low + high) / 2
    half = (high - low) / 2 - radius
    return (middle + BALL[:, None] * radius + half * CORNERS).reshape(-1, 3)


def rod(begin: Vector, end: Vector, thin: float, thick: float, sides: int = 12) -> Part:
    """Returns a round rod from one end, of radius `thin`, to the other, of radius `thick`."""
    begin = np.asarray(begin, np.float64)
    end = np.asarray(end, np.float64)
    along = end - begin
    across = np.linalg.svd(along[None])[2][1:]
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ across
    return np.concatenate([begin + thin * ring, end + thick * ring])


def post(begin: Vector, end: Vector, thin: float, thick: float) -> Part:
    """Returns an upright square rod."""
    square = np.array([[x, 0.0, z] for x in (-1, 1) for z in (-1, 1)])
    return np.concatenate([np.asarray(begin) + thin * square, np.asarray(end) + thick * square])


def bar(begin: Vector, end: Vector, radius: float) -> Part:
    """Returns a round rod of constant radius."""
    return rod(begin, end, radius, radius, 8)


def disc(place: Vector, radius: float, thick: float, narrow: float = 1.0) -> Part:
    """Returns a horizontal disc on its underside's middle; its depth is `narrow` × its width."""
    x, y, z = place
    lying = rod(place, (x, y + thick, z), radius, radius, 48)
    return lying * (1, 1, narrow)


def bowed(low: Vector, high: Vector, bow: float, radius: float) -> list[Part]:
    """Returns an upright board whose sides are `bow` in front of its middle."""
    ends = np.linspace(low[0], high[0], 2 if not bow else 8)
    depths = bow * (ends / max(abs(ends[0]), 1e-9)) ** 2
    edges = [block((x, low[1], low[2] + z), (x + 1e-3, high[1], high[2] + z), radius) for x, z in zip(ends, depths)]
    return [np.concatenate(pair) for pair in pairwise(edges)]


def sheet(grid: Float[np.ndarray, "rows columns 3"], thick: float) -> list[Part]:
    """Returns a curved sheet through the points of a grid: one part for each four neighbours."""
    corners = np.concatenate([grid[:-1, :-1], grid[1:, :-1], grid[:-1, 1:], grid[1:, 1:]], axis=-1).reshape(-1, 4, 3)
    return list((corners[:, :, None] + thick / 2 * OCTAHEDRON).reshape(len(corners), -1, 3))


def row(count: int, low: Vector, high: Vector, radius: float, axis: int = 0, gap: float = 0.0) -> list[Part]:
    """Returns blocks side by side, `gap` apart."""
    ends = np.linspace(low[axis], high[axis], count + 1)
    parts = []
    for first, last in pairwise(ends):
        begin = np.array(low, np.float64)
        end = np.array(high, np.float64)
        begin[axis], end[axis] = first + gap / 2, last - gap / 2
        parts.append(block(begin, end, radius))
    return parts


def tilted(part: Part, degrees: float) -> Part:
    """Rotates a part about the x axis: its top moves to the front, or to the rear for negative angles."""
    cosine = np.cos(np.radians(degrees))
    sine = np.sin(np.radians(degrees))
    return part @ np.array([[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]])
