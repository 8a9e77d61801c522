"""The splits of the bundled models: which shapes they were trained on, and which are held out."""

from pathlib import Path
from typing import Annotated

import tyro

from distrace.data import shapes
from distrace.data.shapes import Shape

CLASSES = ("sofas", "planes", "tables", "chairs")  # with splits and bundled models
Meshes = Annotated[
    Path, tyro.conf.arg(help="as `distrace data furniture` and `… planes` make them, in folders of their own")
]
FOLDER = Path(__file__).parent / "splits"


def read_split(name: str | Path) -> list[Shape]:
    """The shapes of a split by its name (`sofas`), or of a CSV file with the same columns.

    Raises `ValueError` where there is no such split, or a column or a value is missing.
    """
    own = FOLDER / f"{name}.csv"
    if own.is_file():
        return shapes.read_split(own)
    if not Path(name).is_file():
        names = ", ".join(sorted(path.stem for path in FOLDER.glob("*.csv")))
        raise ValueError(f"there is no split {name}; give one of {names}, or a CSV file")
    return shapes.read_split(name)


def on_side(side: str, split: str | Path) -> list[Shape]:
    """Those of a split on its side `train` or `test`."""
    return [shape for shape in read_split(split) if shape.split == side]


def shape_of(split: str | Path, name: str) -> Shape:
    """Raises `ValueError` where the split has no shape of that name."""
    for shape in read_split(split):
        if shape.name == name:
            return shape
    raise ValueError(f"the split {split} has no shape {name}")
