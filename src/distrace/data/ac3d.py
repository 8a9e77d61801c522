"""AC3D files (.ac), as FlightGear's aircraft are: polygons of a tree of objects, each placed in its parent.

The format is Colebourne's, *The AC3D file format* (Inivis). Of it positions and polygons are read.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

POLYGON = 0  # of the kinds of surfaces; the others are lines


@dataclass(frozen=True)
class Frame:
    """From an object's coordinates to the world's: v · rotation + shift."""

    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    shift: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    def of(self, child: "Frame") -> "Frame":
        return Frame(child.rotation @ self.rotation, child.shift @ self.rotation + self.shift)


def load_ac3d(path: Path) -> Float[np.ndarray, "triangles 3 3"]:
    """All triangles of a file in the world's coordinates; polygons are split into fans.

    Raises `ValueError` for a file that is none, that ends early, or whose surfaces have corners it does not hold.
    """
    lines = (words for line in path.read_text(encoding="latin-1").splitlines() if (words := line.split()))
    if not "".join(next(lines, [])).startswith("AC3D"):
        raise ValueError("it does not begin with AC3D")
    triangles: list[np.ndarray] = []
    try:
        while any(words[0] == "OBJECT" for words in lines):
            _read(lines, Frame(), triangles)
    except (StopIteration, IndexError) as error:
        raise ValueError("it ends early, or has surfaces with corners that it does not hold") from error
    if not triangles:
        raise ValueError("it holds no polygon")
    return np.concatenate(triangles)


def _read(lines: Iterator[list[str]], parent: Frame, triangles: list[np.ndarray]) -> None:
    """One object and those in it, whose number comes last."""
    frame, own, vertices = parent, Frame(), np.empty((0, 3))
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
            fans = [_fan(lines) for _ in range(int(values[0]))]
            triangles.extend(vertices[fan] for fan in fans if len(fan))
        elif word == "kids":
            for _ in range(int(values[0])):
                if any(words[0] == "OBJECT" for words in lines):  # some files announce more than there are
                    _read(lines, frame, triangles)
            return


def _fan(lines: Iterator[list[str]]) -> np.ndarray:
    """The corners of a surface's triangles; none of lines, and of what has fewer than three corners."""
    kind = POLYGON
    for words in lines:
        if words[0] == "SURF":
            kind = int(words[1], 16) & 0xF
        elif words[0] == "refs":
            corners = [int(next(lines)[0]) for _ in range(int(words[1]))]
            if min(corners, default=0) < 0:
                raise ValueError("a corner has a negative number")
            count = len(corners) - 2 if kind == POLYGON else 0
            return np.array([(corners[0], *corners[k + 1 : k + 3]) for k in range(count)], int).reshape(-1, 3)
    raise ValueError("it ends within a surface")
