"""`transforms.json`, as NeRF (Mildenhall et al., ECCV 2020), instant-ngp and nerfstudio write it."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from distrace.camera import Camera
from distrace.data.photo_readers.frames import SUFFIXES, Frame, Frames, file_of, matrix, object_list, read_json
from distrace.data.photograph import Source
from distrace.data.pictures import picture_size
from distrace.data.unit_sphere import MAX_COORDINATE
from distrace.errors import about
from distrace.files import atomic_write, save_json

NAMES = ("transforms.json", "transforms_train.json")
UNDISTORTED = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")  # if terms are zero
TERMS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
OTHER_CAMERAS = ("fisheye", "latlong", "equirectangular", "orthographic", "ortho")
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # its cameras look along −z, with y up


def read(folder: Path) -> Frames | None:
    """None where there is no such file; raises `ValueError` for one that is not as it should be.

    The world stays as it is: often z is up in it.
    """
    path = next((folder / name for name in NAMES if (folder / name).is_file()), None)
    if path is None:
        return None
    content = read_json(path)
    entries = object_list(content, "frames", path)
    frames = tuple(_frame(folder, content | entry, f"{path}: frames[{k}]") for k, entry in enumerate(entries))
    return Frames(path.name, frames)


def _frame(folder: Path, entry: dict[str, Any], field: str) -> Frame:
    """Of a frame, with what is said for all frames wherever it says nothing itself."""
    with about(field):
        _check_distortion(entry)
        image = file_of(folder, entry, "file_path", ("", *SUFFIXES))
        mask = file_of(folder, entry, "mask_path", ("", *SUFFIXES)) if entry.get("mask_path") is not None else None
        has_size = "w" in entry and "h" in entry
        size = (int(_number(entry, "h")), int(_number(entry, "w"))) if has_size else picture_size(image)
        pose = matrix(entry, "transform_matrix", 4, 4) @ OPENGL
        return Frame(f"{field}.transform_matrix", image, _intrinsics(entry, *size), pose, mask, size)


def _check_distortion(entry: dict[str, Any]) -> None:
    model = entry.get("camera_model") or "OPENCV"
    if model not in UNDISTORTED:
        raise ValueError(f"camera_model is {model!r}, and only pinhole cameras are read; undistort the images first")
    for name, value in entry.items():
        if name.removeprefix("is_") in OTHER_CAMERAS and value:
            raise ValueError(f"{name} is {value}, and only pinhole cameras are read; undistort the images first")
        if name in TERMS or name.startswith(("ftheta_p", "distortion")):
            terms = value if isinstance(value, list) else [value]
            if any(_number({name: term}, name) != 0 for term in terms):
                raise ValueError(f"{name} is {value}: the images are distorted; undistort them first, to {name} 0")


def _intrinsics(entry: dict[str, Any], height: int, width: int) -> np.ndarray:
    focal_x = _focal(entry, "x", width)
    focal_y = _focal(entry, "y", height)
    if focal_x is None and focal_y is None:
        raise ValueError("there is neither fl_x nor camera_angle_x; one tells the focal length")
    across = _number(entry, "cx") if "cx" in entry else width / 2
    down = _number(entry, "cy") if "cy" in entry else height / 2
    return np.array([[focal_x or focal_y, 0, across], [0, focal_y or focal_x, down], [0, 0, 1]], np.float64)


def _focal(entry: dict[str, Any], axis: str, length: int) -> float | None:
    """In pixels; None where it is not given along this axis."""
    if f"fl_{axis}" in entry:
        return _positive(entry, f"fl_{axis}", math.inf)
    if f"camera_angle_{axis}" in entry:
        return length / 2 / math.tan(_positive(entry, f"camera_angle_{axis}", math.pi) / 2)
    return None


def _positive(entry: dict[str, Any], name: str, below: float) -> float:
    value = _number(entry, name)
    if not 0 < value < below:
        unit = "pixels" if below == math.inf else "radians, below π"
        raise ValueError(f"{name} is {value}; it is positive, in {unit}")
    return value


def _number(entry: dict[str, Any], name: str) -> float:
    value = entry[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_COORDINATE:
        raise ValueError(f"{name} is {value!r}; a number is needed")
    return float(value)


def save_transforms(folder: Path, sources: Mapping[str, Source]) -> None:
    """Writes photographs, by their names, as `read`, nerfstudio and instant-ngp read them.

    Images and masks outside of the folder are copied to `images` and `masks` in it.
    """
    frames = []
    for name, source in sources.items():
        camera = source.camera
        intrinsics = camera.intrinsics.tolist()
        pose = camera.T_world_camera.cpu().double().numpy() @ OPENGL
        frame = {
            "file_path": _path_within(folder, source.image, f"images/{name}"),
            "w": camera.width,
            "h": camera.height,
            "fl_x": intrinsics[0][0],
            "fl_y": intrinsics[1][1],
            "cx": intrinsics[0][2],
            "cy": intrinsics[1][2],
            "transform_matrix": pose.tolist(),
        }
        if source.mask is not None:
            frame["mask_path"] = _path_within(folder, source.mask, f"masks/{name}")
        frames.append(frame)
    save_json(folder / "transforms.json", {"camera_model": "PINHOLE", "frames": frames})


def _path_within(folder: Path, file: Path, name: str) -> str:
    """Returns the path of a file from the folder; one outside, which `read` would refuse, is copied to `name` first."""
    top = Path(os.path.abspath(folder))
    path = Path(os.path.abspath(file))
    if not path.is_relative_to(top):
        path = top / f"{name}{file.suffix}"
        with atomic_write(path) as copy:
            copy.write(file.read_bytes())
    return path.relative_to(top).as_posix()


def read_cameras(path: Path) -> list[Camera]:
    """Reads the cameras alone, in double, without their images. Raises `ValueError` as `read` does."""
    content = read_json(path)
    cameras = []
    for number, entry in enumerate(object_list(content, "frames", path)):
        with about(f"{path}: frames[{number}]"):
            frame = content | entry
            size = (int(_number(frame, "h")), int(_number(frame, "w")))
            pose = matrix(frame, "transform_matrix", 4, 4) @ OPENGL
            intrinsics = torch.from_numpy(_intrinsics(frame, *size))
            cameras.append(Camera.from_matrices(intrinsics, torch.from_numpy(pose), *size))
    return cameras
