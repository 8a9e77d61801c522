"""Depth images as sensors and other tools store them, and the intrinsics that belong to them."""

import json
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.arrays import camera_of, depth_image, mask_image
from distrace.errors import about, error_context
from distrace.optional import require
from distrace.viewpoint import check_matrices

KINDS = (".png", ".npy", ".exr", ".tif", ".tiff")
MILLIMETRES = 1e-3
NONE = 65535  # what some sensors store where there is no depth
FARTHEST = 100.0  # metres: depths beyond are no depths of an object's sensor


def load_depth_image(path: Path) -> Float[Tensor, "height width"]:
    """Returns depths z in metres, `inf` where there is none: of a 16-bit picture in mm, or of an NPY or EXR in metres.

    Raises `ValueError`, in one sentence, for a file that holds no depths.
    """
    hint = "give a 16-bit PNG in millimetres, or an NPY or EXR in metres"
    with error_context(f"{path} cannot be read as a depth image: {hint}", path):
        kind = path.suffix.lower()
        values = _exr(path) if kind == ".exr" else _array(path) if kind == ".npy" else _picture(path)
        depth = depth_image(values)
    with about(path):
        if not depth.isfinite().any():
            raise ValueError("no pixel has a depth; it takes metres, or millimetres in a 16-bit PNG")
        typical = float(depth[depth.isfinite()].median())
        if typical > FARTHEST:
            raise ValueError(f"its depths are {typical:.4g} m in the median; are they in millimetres?")
    return depth


def load_intrinsics(text: str, height: int, width: int) -> Camera:
    """Returns a camera at the origin from `fx,fy,cx,cy`, or from a file: a 3 × 3 matrix as text, NPY or JSON.

    JSON may be a matrix, or hold `fx`, `fy`, `cx` and `cy`, or `intrinsics`, or `camera_matrix`.
    Raises `ValueError` for anything else.
    """
    meant = "give fx,fy,cx,cy in pixels, or a file with a 3 × 3 matrix"
    with error_context(f"--intrinsics {text} was given; {meant}"):
        matrix = _matrix(text)
    with about(f"--intrinsics {text}"):
        return camera_of(matrix, np.eye(4), height, width)


def load_pose(path: Path) -> Float[Tensor, "4 4"]:
    """Returns the matrix that maps camera axes to the world, from a text file or NPY; lengths are in metres.

    Raises `ValueError`, in one sentence, for anything that is no rigid motion.
    """
    with error_context(
        f"{path} cannot be read as a pose: give the 4 × 4 matrix that maps its camera to the world", path
    ):
        values = np.load(path, allow_pickle=False) if path.suffix.lower() == ".npy" else _numbers_of(path.read_text())
        pose = torch.from_numpy(values.reshape(4, 4)).float()
    with about(path):
        check_matrices(torch.eye(3), pose)
    return pose


def load_mask(path: Path, height: int, width: int) -> Bool[Tensor, "height width"]:
    """Returns where a picture is not black. Raises `ValueError` for one of another size, or with nothing marked."""
    from PIL import Image

    with error_context(f"{path} cannot be read as a mask: give a picture that is white where the object is", path):
        with Image.open(path) as picture:
            values = np.asarray(picture.convert("L"))
    with about(path):
        mask = mask_image(values > values.max() / 2 if values.max() else values, height, width)
        if not mask.any():
            raise ValueError("the mask marks no pixel; it is white where the object is")
    return mask


def _picture(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as picture:
        if picture.mode not in ("I;16", "I;16B", "I", "F"):
            raise ValueError(f"it is a picture of mode {picture.mode}, not of 16 bits")
        values = np.asarray(picture).astype(np.float32)
        return values if picture.mode == "F" else np.where(values == NONE, 0, values) * MILLIMETRES


def _array(path: Path) -> np.ndarray:
    values = np.load(path, allow_pickle=False)
    whole = values.dtype.kind in "iu"  # as sensors count
    return np.where(values == NONE, 0, values) * MILLIMETRES if whole else values


def _exr(path: Path) -> np.ndarray:
    require("an EXR depth image", "OpenEXR")
    import OpenEXR

    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        for name in ("Z", "Y", "R", "V", "depth", "Depth"):
            if name in channels:
                return np.asarray(channels[name].pixels, dtype=np.float32)
        first = next(iter(channels.values()))
        values = np.asarray(first.pixels, dtype=np.float32)
        return values[..., 0] if values.ndim == 3 else values


def _matrix(text: str) -> np.ndarray:
    parts = text.replace(",", " ").split()
    if len(parts) == 4:
        fx, fy, cx, cy = map(float, parts)
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    path = Path(text)
    if "," in text and not path.exists():
        raise ValueError(f"that is {text.count(',') + 1} numbers or words")
    if path.suffix.lower() == ".npy":
        return np.load(path, allow_pickle=False)
    content = path.read_text()
    if path.suffix.lower() != ".json":
        return _numbers_of(content).reshape(3, 3)
    found = json.loads(content)
    if isinstance(found, dict) and "fx" in found:
        return np.array([[found["fx"], 0, found["cx"]], [0, found["fy"], found["cy"]], [0, 0, 1]])
    if isinstance(found, dict):
        found = found.get("intrinsics", found.get("camera_matrix", found))
    if isinstance(found, dict):
        raise ValueError(f"it holds {', '.join(found)}")
    return np.asarray(found, dtype=np.float64).reshape(3, 3)


def _numbers_of(text: str) -> np.ndarray:
    return np.array(text.replace(",", " ").split(), dtype=np.float64)
