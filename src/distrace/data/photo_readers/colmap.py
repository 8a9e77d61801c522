"""COLMAP's models, text or binary (Schönberger and Frahm, CVPR 2016), read by its own library."""

import shutil
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from distrace.data.photo_readers.colmap_files import check_whole, with_point_lines
from distrace.data.photo_readers.frames import SUFFIXES, Frame, Frames, inside
from distrace.errors import DoubtfulResult, about, error_context
from distrace.optional import require

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
MIN_TRACK_LENGTH = 3  # images at least that see a point which is trusted


def read(folder: Path) -> Frames | None:
    """None where there is no model; raises `ValueError` for one that cannot be read, or is distorted.

    Of several models below `sparse` the one with most images is read. COLMAP's pixel centres are at +0.5, as ours. A
    `DoubtfulResult` says which images are left out, as no model has them.
    """
    models = _models(folder)
    if not models:
        return None
    read_models = [(model, _reconstruction(model)) for model in models]
    model, found = max(read_models, key=lambda each: each[1].num_reg_images())  # of equal ones the first
    placed = sorted((image for image in found.images.values() if image.has_pose), key=lambda image: image.name)
    images = sum(path.suffix in SUFFIXES for path in (folder / "images").rglob("*"))
    if len(placed) < images:
        of_models = f", the largest of {len(models)} models," if len(models) > 1 else ""
        sentence = f"{model}{of_models} has {len(placed)} of {images} photographs; the others are left out"
        warnings.warn(sentence, DoubtfulResult, stacklevel=4)
    return Frames("COLMAP", tuple(_frame(folder, model, image) for image in placed), points=_points(found))


def _models(folder: Path) -> list[Path]:
    """Folders with a model: those below `sparse`, else `sparse`, else the folder itself."""
    below = sorted(path for path in folder.glob("sparse/*") if path.is_dir())
    for places in (below, [folder / "sparse"], [folder]):
        models = [place for place in places for kind in ("bin", "txt") if (place / f"cameras.{kind}").is_file()]
        if models:
            return list(dict.fromkeys(models))
    return []


def _reconstruction(model: Path) -> Any:
    """What COLMAP's library reads."""
    require(f"reading {model}", "pycolmap")
    from pycolmap import Reconstruction

    check_whole(model)

    with error_context(f"{model} holds no whole model of COLMAP: cameras, images and points3D, all .bin or all .txt"):
        images = None if (model / "cameras.bin").is_file() else with_point_lines(model / "images.txt")
        if images is None:
            return Reconstruction(model)
        with TemporaryDirectory() as copy:
            shutil.copytree(model, copy, ignore=shutil.ignore_patterns("*.png", "*.jpg"), dirs_exist_ok=True)
            (Path(copy) / "images.txt").write_text(images, encoding="utf-8")
            return Reconstruction(copy)


def _frame(folder: Path, model: Path, image: Any) -> Frame:
    field = f"{model}: image {image.name}"
    with about(field):
        camera = image.camera
        if camera.model_name not in PINHOLES:
            raise ValueError(
                f"its camera is of the model {camera.model_name}, and only PINHOLE and SIMPLE_PINHOLE are read;"
                " undistort with colmap image_undistorter"
            )
        path = inside(folder / "images", image.name, "its name")
        if not path.is_file():
            raise ValueError(f"there is no {image.name} in {folder / 'images'}")
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        mask = _mask(folder / "masks", image.name)
        return Frame(field, path, camera.calibration_matrix(), pose, mask, (camera.height, camera.width))


def _mask(masks: Path, name: str) -> Path | None:
    """NAME.png, as COLMAP calls it, or .png in place of the suffix; None only where there is no folder of masks."""
    if not masks.is_dir():
        return None
    candidates = [masks / f"{name}.png", (masks / name).with_suffix(".png")]
    found = next((path for path in candidates if path.is_file()), None)
    if found is None:
        raise ValueError(f"there is neither {candidates[0].name} nor {candidates[1].name} in {masks}")
    return found


def _points(found: Any) -> Float[np.ndarray, "points 3"]:
    points = [point.xyz for point in found.points3D.values() if point.track.length() >= MIN_TRACK_LENGTH]
    return np.array(points, np.float64).reshape(-1, 3)
