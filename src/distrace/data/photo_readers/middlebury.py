"""`NAME_par.txt`, as in Middlebury's multi-view sets (Seitz et al., CVPR 2006)."""

from pathlib import Path

import numpy as np

from distrace.data.photo_readers.frames import Frame, Frames, file_of
from distrace.errors import about, error_context

NUMBERS = 21  # of a line: intrinsics, rotation, translation
CENTRE = 0.5  # pixels with whole numbers are middles of pixels there, as in the tools that calibrate, and corners here


def read(folder: Path) -> Frames | None:
    """None where there is no file of that name; raises `ValueError` for one that is not as it should be."""
    paths = sorted(folder.glob("*_par.txt"))
    if not paths:
        return None
    if len(paths) > 1:
        raise ValueError(f"{folder} holds {', '.join(path.name for path in paths)}; keep one of them")
    path = paths[0]
    with error_context(f"{path} does not begin with the number of its images"):
        first, *lines = path.read_text(encoding="utf-8").split("\n")
        count = int(first)
    rows = [(k, words) for k, line in enumerate(lines, 2) if (words := line.split())]
    if len(rows) != count:
        raise ValueError(f"{path}: line 1 announces {count} images, and {len(rows)} follow; is it cut off?")
    return Frames("Middlebury", tuple(_frame(folder, words, f"{path}: line {k}") for k, words in rows))


def _frame(folder: Path, words: list[str], field: str) -> Frame:
    with about(field):
        image = file_of(folder, {"imgname": words[0]}, "imgname")
        with error_context(f"{words[0]} is followed by {len(words) - 1} words; {NUMBERS} numbers are needed: K, R, t"):
            numbers = np.array(words[1:], np.float64)
            intrinsics, rotation, shift = np.split(numbers.reshape(NUMBERS), (9, 18))
        intrinsics = intrinsics.reshape(3, 3)
        rotation = rotation.reshape(3, 3)
        intrinsics[:2, 2] += CENTRE
        pose = np.eye(4)
        pose[:3, :3] = rotation.T
        pose[:3, 3] = -rotation.T @ shift
        return Frame(field, image, intrinsics, pose)
