"""The cameras and files of a folder's photographs, in any layout, before their pixels are read."""

import json
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from jaxtyping import Float

from distrace.data.unit_sphere import UnitSphere
from distrace.errors import error_context

SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


@dataclass(frozen=True)
class Frame:
    """One view: files and a camera in OpenCV's axes, in the folder's world and in pixels with centres at +0.5."""

    field: str  # file and field that say so, for errors
    image: Path
    intrinsics: Float[np.ndarray, "rows columns"]  # what these hold is checked with the image
    T_world_camera: Float[np.ndarray, "rows_ columns_"]
    mask: Path | None = None
    size: tuple[int, int] | None = None  # height and width, where the folder has them


@dataclass(frozen=True)
class Frames:
    """All views, and where the folder has them the unit sphere and points of the scene."""

    layout: str
    views: tuple[Frame, ...]
    unit_sphere: UnitSphere | None = None
    points: Float[np.ndarray, "points 3"] | None = None


def read_json(path: Path) -> dict[str, Any]:
    """Raises `ValueError` for a file that is no JSON, or no object."""
    with error_context(f"{path} cannot be read as JSON", path):
        content = json.loads(path.read_text(encoding="utf-8-sig"))  # some editors write a mark first
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds a {type(content).__name__}; an object with names is needed")
    return content


def object_list(content: dict[str, Any], name: str, path: Path) -> list[dict[str, Any]]:
    """A list of objects in a JSON file; raises `ValueError` for anything else."""
    entries = content.get(name)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"{path}: {name} is no list of objects; each of them describes one view")
    return entries


def matrix(entry: dict[str, Any], name: str, *shape: int) -> Float[np.ndarray, "rows columns"]:
    """Raises `ValueError`, naming the field, where it is no finite matrix of that shape."""
    with error_context(f"{name} is no matrix of {' × '.join(map(str, shape))} numbers"):
        values = np.array(entry[name], np.float64)
        if values.shape != shape:
            raise ValueError(f"its shape is {list(values.shape)}")
        if not np.isfinite(values).all():
            raise ValueError("it holds values that are not finite")
    return values


def file_of(folder: Path, entry: dict[str, Any], name: str, suffixes: Iterable[str] = ("",)) -> Path:
    """The file that a field names, with the first of the suffixes that there is.

    Raises `ValueError`, naming the field, where it names none, none that exists, or one outside of the folder.
    """
    given = entry.get(name)
    if not isinstance(given, str) or not given:
        raise ValueError(f"{name} is {given!r}; it is the path of a file, from the folder")
    target = inside(folder, given, name)
    for suffix in suffixes:
        if (found := target.with_name(target.name + suffix)).is_file():
            return found
    raise ValueError(f"{name} names {given}, and there is no such file in {folder}")


def inside(folder: Path, given: str, name: str) -> Path:
    """Raises `ValueError` for a path that leaves the folder by its words; a link that someone made there may."""
    path = Path(os.path.normpath(given))
    if PureWindowsPath(given).anchor or ".." in path.parts:
        raise ValueError(f"{name} names {given}, which leaves {folder}; put the file inside")
    return folder / path


def images_in(folder: Path) -> list[Path]:
    """In the order of the numbers in their names."""
    found = [path for path in folder.glob("*") if path.suffix in SUFFIXES and not path.name.startswith(".")]
    return sorted(
        found, key=lambda path: [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", path.name)]
    )
