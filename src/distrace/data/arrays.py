"""Reads and checks the arrays of `OBSERVATION.npz`: the images and the camera of a view."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.checks import check_intrinsics
from distrace.errors import error_context

NAMES = ("depth", "intrinsics", "T_world_camera", "mask", "normal")
MAX_PIXELS = 8192 * 4096  # pixels
LENGTH_TOLERANCE = 1e-4  # by which a unit normal may be too long


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Those of NAMES that an `.npz` holds; nothing in it is unpickled. Raises `ValueError` for any other file."""
    with error_context(f"{path} is not an observation: an .npz with depth, intrinsics and T_world_camera", path):
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in NAMES if name in archive.files}
        return {name: arrays[name] for name in (*NAMES[:3], *arrays)}  # a KeyError names what is missing


def depth_image(array: np.ndarray) -> Float[Tensor, "height width"]:
    """`inf` where there is none: zero, negative, infinite or NaN. Raises `ValueError` where z points backward."""
    depth = _numbers("depth", _flat(array, 2))
    if depth.dim() != 2 or not 0 < depth.numel() <= MAX_PIXELS:
        most = f"{MAX_PIXELS:,} pixels"
        raise ValueError(f"depth has shape {list(array.shape)}; an image [height, width] of 1 to {most} is needed")
    finite = depth[depth.isfinite()]
    if not (finite > 0).any() and len(finite[finite < 0].unique()) > 1:
        raise ValueError(
            f"depth is negative wherever there is one, down to {finite.min():.4g}; it is z along the camera's axis,"
            " which points forward (OpenCV): change its sign"
        )
    return torch.where(depth.isfinite() & (depth > 0), depth, torch.inf)


def camera_of(intrinsics: np.ndarray, pose: np.ndarray, height: int, width: int) -> Camera:
    """Raises `ValueError` where the matrices are no pinhole camera's of such an image."""
    matrices = _numbers("intrinsics", _flat(intrinsics, 2)), _numbers("T_world_camera", _flat(pose, 2))
    with error_context("no camera is described"):
        camera = Camera.from_matrices(*matrices, height, width)
    if camera.intrinsics.dim() != 2:
        raise ValueError(f"{len(intrinsics)} cameras are described; one depth image has one")
    check_intrinsics(camera)
    return camera


def mask_image(array: np.ndarray, height: int, width: int) -> Bool[Tensor, "height width"]:
    """True wherever it is not zero. Raises `ValueError` for more than two values."""
    mask = _image("mask", array, height, width)
    if mask.dtype.kind not in "biuf":
        raise ValueError(f"mask holds {mask.dtype}; it is True where the object is and False elsewhere")
    values = np.unique(mask)
    if not np.isfinite(values).all() or (values != 0).sum() > 1:
        listed = ", ".join(f"{value:.4g}" for value in values[:4]) + (", …" if len(values) > 4 else "")
        raise ValueError(
            f"mask holds the values {listed}; only False and True, or zero and one other number, say what is object"
        )
    return torch.from_numpy(mask != 0)


def normal_image(array: np.ndarray, height: int, width: int) -> Float[Tensor, "height width 3"]:
    """Unit normals; zero where unknown: zero or not finite. Raises `ValueError` where none is known."""
    if array.dtype.kind == "u":
        raise ValueError(f"normal holds {array.dtype}, as pictures do; give unit vectors in world axes")
    normal = _numbers("normal", _image("normal", array, height, width, 3))
    length = normal.double().norm(dim=-1, keepdim=True)
    known = length.isfinite() & (length > 0)
    if not known.any():
        raise ValueError(
            "normal is zero or not finite at every pixel; give unit vectors in world axes, or leave it out"
        )
    unit = torch.where((length - 1).abs() < LENGTH_TOLERANCE, normal, (normal / length).float())
    return torch.where(known, unit, 0.0)


def _image(name: str, array: np.ndarray, *shape: int) -> np.ndarray:
    flat = _flat(array, len(shape))
    if flat.shape != shape:
        raise ValueError(f"{name} has shape {list(array.shape)}; beside this depth it must be {list(shape)}")
    return flat


def _flat(array: np.ndarray, axes: int) -> np.ndarray:
    """Without an axis of 1 behind or before the others."""
    if array.ndim != axes + 1 or 1 not in (array.shape[0], array.shape[-1]):
        return array
    return array[..., 0] if array.shape[-1] == 1 else array[0]


def _numbers(name: str, array: np.ndarray) -> Tensor:
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} holds {array.dtype}; numbers are needed")
    with np.errstate(over="ignore"):  # what is too large for float32 becomes inf
        return torch.from_numpy(array.astype(np.float32))
