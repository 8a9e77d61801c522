"""AC3D files (.ac), as FlightGear's aircraft are: polygons of a tree of objects, each placed in its parent.

The format is Colebourne's, *The AC3D file format* (Inivis). Of it positions, polygons, colours and textures are read.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

POLYGON = 0  # of the kinds of surfaces; the others are lines


@dataclass(frozen=True)
class Surfaces:
    """The triangles of one object, in the world's coordinates."""

    corners: Float[np.ndarray, "triangles 3 3"]
    uv: Float[np.ndarray, "triangles 3 2"]  # of its image, v up
    material: Int[np.ndarray, "triangles"]
    image: str  # the file's name without its folder, which often is one of somebody else's machine


def load_ac3d(path: Path) -> Float[np.ndarray, "triangles 3 3"]:
    """Returns all triangles of a file in the world's coordinates. Raises `ValueError` as `load_surfaces` does."""
    return np.concatenate([surfaces.corners for surfaces in load_surfaces(path)[1]])


def load_surfaces(path: Path) -> tuple[Float[np.ndarray, "materials 3"], list[Surfaces]]:
    """Returns the colours of a file's materials (sRGB, 0 to 1), and its objects; polygons are split into fans.

    Raises `ValueError` for a file that is none, that ends early, or whose surfaces have corners it does not hold.
    """
    lines = (words for line in path.read_text(encoding="latin-1").splitlines() if (words := line.split()))
    if not "".join(next(lines, [])).startswith("AC3D"):
        raise ValueError("it does not begin with AC3D")
    colours: list[list[float]] = []
    found: list[Surfaces] = []
    try:
        for word, *values in lines:
            if word == "MATERIAL" and "rgb" in values:
                first = values.index("rgb") + 1
                colours.append([float(value) for value in values[first : first + 3]])
            elif word == "OBJECT":
                _read(lines, np.eye(3), np.zeros(3), found)
    except (StopIteration, IndexError) as error:
        raise ValueError("it ends early, or has surfaces with corners that it does not hold") from error
    if not found:
        raise ValueError("it holds no polygon")
    return np.array(colours).reshape(-1, 3), found


def _read(
    lines: Iterator[list[str]], rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"], found: list[Surfaces]
) -> None:
    """Adds one object, and those in it, whose number comes last. Its parent's frame is v · rotation + shift."""
    own_rotation = np.eye(3)
    own_shift = np.zeros(3)
    vertices = np.empty((0, 3))
    image = ""
    repeat = np.ones(2)
    offset = np.zeros(2)
    for word, *values in lines:
        if word == "data":
            next(lines, None)
        elif word == "rot":
            own_rotation = np.array(values[:9], np.float64).reshape(3, 3)
        elif word == "loc":
            own_shift = np.array(values[:3], np.float64)
        elif word == "texture":
            image = re.split(r"[/\\]", " ".join(values).strip('"'))[-1]
        elif word == "texrep":
            repeat = np.array(values[:2], np.float64)
        elif word == "texoff":
            offset = np.array(values[:2], np.float64)
        elif word == "numvert":
            own = np.array([next(lines)[:3] for _ in range(int(values[0]))], np.float64).reshape(-1, 3)
            vertices = (own @ own_rotation + own_shift) @ rotation + shift
        elif word == "numsurf":
            fans = [fan for _ in range(int(values[0])) if (fan := _fan(lines))]
            if fans:
                corners, uv, material = (np.concatenate(parts) for parts in zip(*fans))
                found.append(Surfaces(vertices[corners], uv * repeat + offset, material, image))
        elif word == "kids":
            for _ in range(int(values[0])):
                if any(words[0] == "OBJECT" for words in lines):  # some files announce more than there are
                    _read(lines, own_rotation @ rotation, own_shift @ rotation + shift, found)
            return


def _fan(lines: Iterator[list[str]]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Returns a surface's triangles: vertices, uv and material. None for lines, and for less than three corners."""
    kind = POLYGON
    material = 0
    for words in lines:
        if words[0] == "SURF":
            kind = int(words[1], 16) & 0xF
        elif words[0] == "mat":
            material = int(words[1])
        elif words[0] == "refs":
            refs = [next(lines) for _ in range(int(words[1]))]
            corners = np.array([int(ref[0]) for ref in refs], int)
            if (corners < 0).any():
                raise ValueError("a corner has a negative number")
            if kind != POLYGON or len(refs) < 3:
                return None
            uv = np.array([[*map(float, ref[1:3]), 0.0, 0.0][:2] for ref in refs])
            order = np.array([(0, k + 1, k + 2) for k in range(len(refs) - 2)])
            return corners[order], uv[order], np.full(len(order), material)
    raise ValueError("it ends within a surface")
