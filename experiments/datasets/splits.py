"""The splits of the bundled models: training shapes and held-out shapes."""

from pathlib import Path
from typing import Annotated

import tyro

from distrace.data import shapes
from distrace.data.shapes import Shape

CLASSES = ("sofas", "planes", "tables", "chairs")  # with splits and bundled models
Meshes = Annotated[
    Path, tyro.conf.arg(help="the folder of out/furniture and out/planes, as `distrace data` makes them")
]
FOLDER = Path(__file__).parent / "splits"


def read_split(name: str | Path) -> list[Shape]:
    """Returns the shapes of a split by its name (`sofas`), or of a CSV file with the same columns.

    Raises `ValueError` for an unknown split, or for a missing column or value.
    """
    bundled = FOLDER / f"{name}.csv"
    if bundled.is_file():
        return shapes.read_split(bundled)
    if not Path(name).is_file():
        names = ", ".join(sorted(path.stem for path in FOLDER.glob("*.csv")))
        raise ValueError(f"there is no split {name}; give one of {names}, or a CSV file")
    return shapes.read_split(name)


def on_side(side: str, split: str | Path) -> list[Shape]:
    """Returns the shapes of a split on its side `train` or `test`."""
    return [shape for shape in read_split(split) if shape.split == side]


def shape_of(split: str | Path, name: str) -> Shape:
    """Returns the shape of that name. Raises `ValueError` where the split has none."""
    for shape in read_split(split):
        if shape.name == name:
            return shape
    raise ValueError(f"the split {split} has no shape {name}")
