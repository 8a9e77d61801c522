"""`cameras_sphere.npz`, as IDR (Yariv et al., NeurIPS 2020) and NeuS (Wang et al., NeurIPS 2021) read it."""

from pathlib import Path

import numpy as np
import torch

from distrace.data.photo_readers.frames import Frame, Frames, images_in, matrix
from distrace.data.unit_sphere import UnitSphere
from distrace.errors import about, error_context

NAME = "cameras_sphere.npz"
TOLERANCE = 1e-5  # of the radius, between the scales of views and of axes


def read(folder: Path) -> Frames | None:
    """None where there is no cameras_sphere.npz; raises `ValueError` for one that is not as it should be.

    Principal points stay as they are. In some of these files pixel centres are at 0 (DTU's, whose quarters have them
    at 3/8), in others, made from COLMAP's cameras, at 1/2; nothing in a file tells.
    """
    path = folder / NAME
    if not path.is_file():
        return None
    images = images_in(folder / "image")
    masks = images_in(folder / "mask")
    matrices = _matrices(path)
    _check_counts(path, matrices, images, masks)
    if not images:
        return Frames("IDR", ())
    places = masks or [None] * len(images)
    frames = tuple(_frame(path, matrices, k, image, mask) for k, (image, mask) in enumerate(zip(images, places)))
    return Frames("IDR", frames, _unit_sphere(path, matrices, len(images)))


def _matrices(path: Path) -> dict[str, np.ndarray]:
    with (
        error_context(f"{path} cannot be read as an .npz of matrices", path),
        np.load(path, allow_pickle=False) as archive,
    ):
        return {name: archive[name] for name in archive.files if name.startswith(("world_mat_", "scale_mat_"))}


def _check_counts(path: Path, matrices: dict[str, np.ndarray], images: list[Path], masks: list[Path]) -> None:
    described = sum(name.removeprefix("world_mat_").isdigit() for name in matrices)
    beside = f"{path.parent / 'image'} holds {len(images)} images"
    if described != len(images):
        raise ValueError(f"{path} holds {described} matrices world_mat_N, and {beside}; there is one for each")
    if masks and len(masks) != len(images):
        raise ValueError(
            f"{path.parent / 'mask'} holds {len(masks)} masks, and {beside}; there is one for each, or none"
        )


def _frame(path: Path, matrices: dict[str, np.ndarray], k: int, image: Path, mask: Path | None) -> Frame:
    field = f"{path}: world_mat_{k}"
    with about(path):
        projection = matrix(matrices, f"world_mat_{k}", 4, 4)[:3]
    with about(field):
        return Frame(field, image, *decomposed(projection), mask)


def decomposed(projection: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics and T_world_camera of K [R t] times any number, by an RQ decomposition.

    After Hartley and Zisserman, *Multiple View Geometry*, section 6.2.4. Raises `ValueError` where there is none.
    """
    left = projection[:, :3] * np.sign(np.linalg.det(projection[:, :3]))
    if not np.linalg.cond(left) < 1e12:
        raise ValueError("its left three columns have no inverse; it maps points of the world to pixels")
    from scipy.linalg import rq

    upper, rotation = rq(left)
    signs = np.sign(np.diag(upper))  # the decomposition is unique with a positive diagonal
    upper = upper * signs
    rotation = rotation * signs[:, None]
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    return upper / upper[2, 2], pose


def _unit_sphere(path: Path, matrices: dict[str, np.ndarray], count: int) -> UnitSphere:
    with about(path):
        scales = [matrix(matrices, f"scale_mat_{k}", 4, 4) for k in range(count)]
        first = scales[0]
        radius = float(first[0, 0])
        plain = first.copy()
        plain[:3, :3] = radius * np.eye(3)
        plain[3] = (0, 0, 0, 1)
        if not radius > 0 or np.abs(plain - first).max() > TOLERANCE * radius:
            raise ValueError("scale_mat_0 is no scale and shift; it maps the unit sphere to the world")
        for k, scale in enumerate(scales):
            if np.abs(scale - first).max() > TOLERANCE * radius:
                raise ValueError(f"scale_mat_{k} is another than scale_mat_0; all views are of one unit sphere")
    return UnitSphere(torch.from_numpy(first[:3, 3].copy()), radius)
