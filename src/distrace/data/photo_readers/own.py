"""Our own layout: `views.json` beside the images, with matrices as distrace has them."""

from pathlib import Path
from typing import Any

from distrace.data.photo_readers.frames import Frame, Frames, file_of, matrix, object_list, read_json
from distrace.data.unit_sphere import UnitSphere, unit_sphere_of
from distrace.errors import about

NAME = "views.json"


def read(folder: Path) -> Frames | None:
    """None where there is no views.json; raises `ValueError` for one that is not as it should be."""
    path = folder / NAME
    if not path.is_file():
        return None
    content = read_json(path)
    entries = object_list(content, "views", path)
    frames = tuple(_frame(folder, entry, f"{path}: views[{k}]") for k, entry in enumerate(entries))
    return Frames("views.json", frames, _unit_sphere(content, path))


def _frame(folder: Path, entry: dict[str, Any], field: str) -> Frame:
    with about(field):
        image = file_of(folder, entry, "image")
        mask = file_of(folder, entry, "mask") if entry.get("mask") is not None else None
        return Frame(field, image, matrix(entry, "intrinsics", 3, 3), matrix(entry, "T_world_camera", 4, 4), mask)


def _unit_sphere(content: dict[str, Any], path: Path) -> UnitSphere | None:
    sphere = content.get("unit_sphere")
    if sphere is None:
        return None
    with about(f"{path}: unit_sphere"):
        return unit_sphere_of(sphere)
