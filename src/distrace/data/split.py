"""Which shapes a model is trained on and which are held out, fixed in a file: `splits/sofas.csv`."""

import csv
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb")


@dataclass(frozen=True)
class Shape:
    """A mesh, where it lies in its catalogue, and which side of the split its design is on."""

    name: str
    split: str  # train or test
    design: str  # close variants of one design stay on one side
    turn: float  # degrees about y that bring it to the orientation of its class
    path: str
    creator: str
    licence: str


def read_split(name: str | Path) -> list[Shape]:
    """The shapes of a bundled split (`sofas`) or of a CSV file with the same columns.

    Raises `ValueError` where there is no such split, or a column is missing.
    """
    bundled = files("distrace") / "splits" / f"{name}.csv"
    source = bundled if bundled.is_file() else Path(name)
    if not source.is_file():
        raise ValueError(f"there is no split {name}: give the name of a bundled one (sofas) or a CSV file")
    rows = csv.DictReader(source.read_text().splitlines())
    missing = [column for column in Shape.__dataclass_fields__ if column not in (rows.fieldnames or [])]
    if missing:
        raise ValueError(f"the split {name} lacks the columns {', '.join(missing)}")
    return [Shape(**{**row, "turn": float(row["turn"])}) for row in rows]


def every_mesh(folder: Path) -> list[Shape]:
    """All mesh files below a folder as training shapes, named by their paths.

    Raises `ValueError` where there is none.
    """
    paths = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in MESH_SUFFIXES)
    if not paths:
        raise ValueError(f"{folder} holds no mesh; files ending in {', '.join(MESH_SUFFIXES)} are looked for")
    names = ["-".join(path.with_suffix("").parts) for path in paths]
    return [Shape(name, "train", name, 0.0, str(path), "", "") for name, path in zip(names, paths)]
