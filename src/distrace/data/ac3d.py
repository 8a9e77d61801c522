"""AC3D files (.ac), as FlightGear's aircraft are: polygons of a tree of objects, each placed in its parent.

The format is Colebourne's, *The AC3D file format* (Inivis). Of it positions, polygons, colours and textures are read.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

POLYGON = 0  # of the kinds of surfaces; the others are lines


@dataclass(frozen=True)
class Frame:
    """From an object's coordinates to the world's: v · rotation + shift."""

    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    shift: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    def of(self, child: "Frame") -> "Frame":
        return Frame(child.rotation @ self.rotation, child.shift @ self.rotation + self.shift)


@dataclass(frozen=True)
class Surfaces:
    """The triangles of one object, in the world's coordinates."""

    corners: Float[np.ndarray, "triangles 3 3"]
    uv: Float[np.ndarray, "triangles 3 2"]  # of its image, v up
    material: Int[np.ndarray, "triangles"]
    image: str  # the file's name without its folder, which often is one of somebody else's machine


@dataclass
class _Image:
    name: str = ""
    repeat: Float[np.ndarray, "2"] = field(default_factory=lambda: np.ones(2))
    offset: Float[np.ndarray, "2"] = field(default_factory=lambda: np.zeros(2))

    def read(self, word: str, values: list[str]) -> None:
        if word == "texture":
            self.name = re.split(r"[/\\]", " ".join(values).strip('"'))[-1]
        elif word == "texrep":
            self.repeat = np.array(values[:2], np.float64)
        elif word == "texoff":
            self.offset = np.array(values[:2], np.float64)


def load_ac3d(path: Path) -> Float[np.ndarray, "triangles 3 3"]:
    """All triangles of a file in the world's coordinates. Raises `ValueError` as `load_surfaces` does."""
    return np.concatenate([surfaces.corners for surfaces in load_surfaces(path)[1]])


def load_surfaces(path: Path) -> tuple[Float[np.ndarray, "materials 3"], list[Surfaces]]:
    """The colours of a file's materials (sRGB, 0 to 1), and its objects; polygons are split into fans.

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
                _read(lines, Frame(), found)
    except (StopIteration, IndexError) as error:
        raise ValueError("it ends early, or has surfaces with corners that it does not hold") from error
    if not found:
        raise ValueError("it holds no polygon")
    return np.array(colours).reshape(-1, 3), found


def _read(lines: Iterator[list[str]], parent: Frame, found: list[Surfaces]) -> None:
    """One object and those in it, whose number comes last."""
    frame = parent
    own = Frame()
    vertices = np.empty((0, 3))
    image = _Image()
    for word, *values in lines:
        if word == "data":
            next(lines, None)
        elif word == "rot":
            own = Frame(np.array(values[:9], np.float64).reshape(3, 3), own.shift)
            frame = parent.of(own)
        elif word == "loc":
            own = Frame(own.rotation, np.array(values[:3], np.float64))
            frame = parent.of(own)
        elif word == "numvert":
            vertices = np.array([next(lines)[:3] for _ in range(int(values[0]))], np.float64).reshape(-1, 3)
            vertices = vertices @ frame.rotation + frame.shift
        elif word == "numsurf":
            fans = [fan for _ in range(int(values[0])) if (fan := _fan(lines)) is not None]
            if fans:
                found.append(_surfaces(vertices, fans, image))
        elif word == "kids":
            for _ in range(int(values[0])):
                if any(words[0] == "OBJECT" for words in lines):  # some files announce more than there are
                    _read(lines, frame, found)
            return
        else:
            image.read(word, values)


@dataclass(frozen=True)
class _Fan:
    corners: Int[np.ndarray, "triangles 3"]
    uv: Float[np.ndarray, "triangles 3 2"]
    material: int


def _fan(lines: Iterator[list[str]]) -> _Fan | None:
    """A surface's triangles; None of lines, and of what has fewer than three corners."""
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
            return _Fan(corners[order], uv[order], material)
    raise ValueError("it ends within a surface")


def _surfaces(vertices: Float[np.ndarray, "vertices 3"], fans: list[_Fan], image: _Image) -> Surfaces:
    uv = np.concatenate([fan.uv for fan in fans]) * image.repeat + image.offset
    material = np.repeat([fan.material for fan in fans], [len(fan.corners) for fan in fans])
    return Surfaces(vertices[np.concatenate([fan.corners for fan in fans])], uv, material, image.name)
