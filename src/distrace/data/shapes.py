"""Which meshes a model is trained on and which are held out: by a CSV file, or all below a folder."""

import csv
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields
from pathlib import Path

from distrace.errors import about, error_context

SIDES = ("train", "test", "out")
MESH_SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb", ".ac")


@dataclass(frozen=True)
class Shape:
    """A mesh, where it lies in its catalogue, and which side of the split its design is on."""

    name: str
    split: str  # train, test, or out of both
    design: str  # close variants of one design stay on one side
    turn: float  # degrees about y that bring it to the orientation of its class
    path: str
    creator: str
    licence: str
    note: str = ""  # why it is out


COLUMNS = [field.name for field in fields(Shape) if field.default is MISSING]


def read_split(source: str | Path) -> list[Shape]:
    """The shapes of a CSV file with the columns of `Shape`.

    Raises `ValueError` where there is no such file, or a column or a value is missing.
    """
    source = Path(source)
    if not source.is_file():
        raise ValueError(f"there is no split {source}; give a CSV file with the columns {', '.join(COLUMNS)}")
    with error_context(f"the split {source} cannot be read as a CSV file"):
        rows = csv.DictReader(source.read_text(encoding="utf-8").splitlines())
        missing = [column for column in COLUMNS if column not in (rows.fieldnames or [])]
    if missing:
        raise ValueError(f"the split {source} lacks the columns {', '.join(missing)}")
    with error_context(
        f"the split {source} cannot be read: each row needs all of its columns, and degrees as its turn"
    ):
        shapes = [_shape(row) for row in rows]
    with about(f"the split {source}"):
        return _checked_names(shapes)


def _shape(row: dict[str, str]) -> Shape:
    known = {column: row[column] for column in Shape.__dataclass_fields__ if column in row}
    if None in known.values():
        raise ValueError(f"{', '.join(filter(None, known.values()))} is too short")
    shape = Shape(**{**known, "turn": float(row["turn"])})
    if shape.split not in SIDES or not math.isfinite(shape.turn):
        raise ValueError(f"{shape.name} has the side {shape.split!r} and the turn {shape.turn}")
    return shape


def _checked_names(shapes: list[Shape]) -> list[Shape]:
    """Returns the shapes. Raises `ValueError` where their names cannot be files in one folder, beside `result.json`."""
    for name, count in Counter(shape.name for shape in shapes).items():
        if count > 1:
            paths = ", ".join(shape.path for shape in shapes if shape.name == name)
            raise ValueError(f"{count} shapes are called {name} ({paths}); rename or remove all but one")
        if name != Path(name).name or "\\" in name or name in ("", "..", "result"):
            raise ValueError(f"a shape is called {name!r}, which cannot name its files; rename it")
    return shapes


def every_mesh(folder: Path) -> list[Shape]:
    """All mesh files below a folder as training shapes, named by their paths.

    Raises `ValueError` where there is none.
    """
    paths = sorted(path.relative_to(folder) for path in _meshes(folder))
    if not paths:
        raise ValueError(f"{folder} holds no mesh; files ending in {', '.join(MESH_SUFFIXES)} are looked for")
    names = ["-".join(path.with_suffix("").parts) for path in paths]
    with about(folder):
        return _checked_names([Shape(name, "train", name, 0.0, str(path), "", "") for name, path in zip(names, paths)])


def has_meshes(folder: Path) -> bool:
    return next(_meshes(folder), None) is not None


def _meshes(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.suffix.lower() in MESH_SUFFIXES)
