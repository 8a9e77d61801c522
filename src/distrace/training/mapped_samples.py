"""Samples in files that are mapped into memory: more shapes than fit there, and one copy for all processes."""

import json
from contextlib import ExitStack
from pathlib import Path

import torch

from distrace.errors import error_context
from distrace.files import atomic_write, save_json
from distrace.training.batches import Samples, Side, read_samples, shape_names, warn_of_dropped

FILES = ("outside.f32", "inside.f32")  # rows of four numbers, of one shape after another
INDEX = "index.json"


def map_samples(paths: list[Path], folder: Path) -> None:
    """Writes the samples of DeepSDF's `.npz` files into files that `open_mapped` maps; nothing if they are there.

    Memory holds one shape at a time. Raises `ValueError` as `load_samples` does.
    """
    sources = [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in paths]
    if _index(folder).get("sources") == sources:
        return
    (folder / INDEX).unlink(missing_ok=True)
    counts: list[list[int]] = [[], []]
    dropped = 0
    with ExitStack() as stack:
        files = [stack.enter_context(atomic_write(folder / name)) for name in FILES]
        for path in paths:
            *sides, unusable = read_samples(path)
            dropped += unusable
            for file, rows, numbers in zip(files, sides, counts, strict=True):
                file.write(rows.numpy().tobytes())
                numbers.append(len(rows))
    warn_of_dropped(dropped)
    save_json(folder / INDEX, {"sources": sources, "names": shape_names(paths), "counts": counts})


def open_mapped(folder: Path) -> Samples:
    """Returns samples whose rows are read from the disk when they are drawn."""
    index = _index(folder)
    sides = []
    for name, counts in zip(FILES, index["counts"], strict=True):
        rows = torch.from_file(str(folder / name), shared=False, size=4 * sum(counts), dtype=torch.float32)
        sides.append(Side(rows.reshape(-1, 4), torch.tensor(counts)))
    return Samples(index["names"], *sides)


def _index(folder: Path) -> dict:
    if not (folder / INDEX).is_file():
        return {}
    with error_context(f"{folder / INDEX} is damaged; remove the folder, and it is written again"):
        return dict(json.loads((folder / INDEX).read_text(encoding="utf-8")))
