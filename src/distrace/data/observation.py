"""One observed view: a camera and what it saw. The file form is `OBSERVATION.npz`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile, is_zipfile

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.arrays import camera_of, depth_image, mask_image, normal_image, read_arrays
from distrace.data.checks import check_mask, check_normals, check_place
from distrace.data.points import random_subset
from distrace.errors import about
from distrace.files import save_arrays
from distrace.shading import Picture, shaded_picture

CANONICAL = "canonical"


@dataclass(frozen=True)
class View:
    """An observation of a shape in the unit sphere: a depth image, and a mask and normals where they are known."""

    camera: Camera
    depth: Float[Tensor, "height width"]  # z; `inf` where there is none
    mask: Bool[Tensor, "height width"] | None = None  # where the object is
    normal: Float[Tensor, "height width 3"] | None = None  # unit vectors in world axes; zero where unknown

    @property
    def seen(self) -> Bool[Tensor, "height width"]:
        """Where there is a depth."""
        return torch.isfinite(self.depth)

    @property
    def observed(self) -> Bool[Tensor, "height width"]:
        """Where anything of the object is known: a depth, a normal, or that it is there."""
        known = self.seen if self.mask is None else self.seen | self.mask
        return known if self.normal is None else known | self.normal.any(-1)

    def to(self, device: torch.device | str) -> "View":
        mask, normal = (None if image is None else image.to(device) for image in (self.mask, self.normal))
        return View(self.camera.to(device), self.depth.to(device), mask, normal)

    def points(self) -> Float[Tensor, "n 3"]:
        """The observed points, in the world."""
        rays = self.camera.rays()
        return rays.at(self.depth / self.camera.cosines())[self.seen]

    @property
    def shaded(self) -> Picture | None:
        """As clay, where normals and mask are known."""
        if self.normal is None or self.mask is None:
            return None
        return shaded_picture(self.normal, self.mask, self.camera.rays().directions)

    def masked(self, mask: Bool[Tensor, "height width"]) -> "View":
        """The same view without the depths and normals outside of a mask."""
        depth = self.depth.masked_fill(~mask, torch.inf)
        normal = None if self.normal is None else self.normal.masked_fill(~mask[..., None], 0.0)
        return replace(self, depth=depth, normal=normal)

    def without(self, *parts: str) -> "View":
        """The same view, not knowing `depth`, `mask` or `normal`."""
        depth = torch.full_like(self.depth, torch.inf) if "depth" in parts else self.depth
        return replace(self, depth=depth, **{part: None for part in parts if part != "depth"})

    def sparse(self, count: int, seed: int = 0) -> "View":
        """The same view with only `count` of its depths, drawn at random."""
        kept = random_subset(self.seen.nonzero(), count, seed)
        depth = torch.full_like(self.depth, torch.inf)
        depth[kept[:, 0], kept[:, 1]] = self.depth[kept[:, 0], kept[:, 1]]
        return replace(self, depth=depth)


def load_view(path: Path, ignore: Sequence[str] = ()) -> View:
    """Reads `OBSERVATION.npz`, of a camera that sees the unit sphere; `depth`, `mask` and `normal` can be ignored.

    Raises `ValueError`, in one sentence, for what is missing or makes no sense.
    """
    view = read_view(path, ignore)
    with about(path):
        check_place(view.camera, view.depth, view.observed)
    return view


def read_view(path: Path, ignore: Sequence[str] = ()) -> View:
    """The same wherever the camera is. What lies outside of the mask is left out: it is not the object's."""
    scene, mask = read_scene(path, ignore)
    with about(path):
        view = scene if mask is None else replace(scene, mask=mask).masked(mask)
        view = view.without("depth") if "depth" in ignore else view
        if not view.observed.any():
            left = f"without its {' and '.join(ignore)} " if ignore else ""
            raise ValueError(
                f"{left}it shows nothing: no depth is finite and positive, and no pixel is marked as object"
            )
        if view.normal is not None:
            check_normals(view.camera, view.normal)
    return view


def read_scene(path: Path, ignore: Sequence[str] = ()) -> tuple[View, Bool[Tensor, "height width"] | None]:
    """Reads a view with all its depths, also those of other things than the object; and the object's mask, if known.

    Raises `ValueError`, in one sentence, for what is missing or makes no sense.
    """
    arrays = {name: array for name, array in read_arrays(path).items() if name == "depth" or name not in ignore}
    with about(path):
        depth = depth_image(arrays["depth"])
        size = depth.shape[0], depth.shape[1]
        camera = camera_of(arrays["intrinsics"], arrays["T_world_camera"], *size)
        mask = mask_image(arrays["mask"], *size) if "mask" in arrays else None
        scene = View(camera, depth, None, None)
        shows = scene.seen.any() or (mask is not None and mask.any())
        if "normal" in arrays and (shows or arrays["normal"].any()):  # that of an empty render is zero
            scene = replace(scene, normal=normal_image(arrays["normal"], *size))
        if mask is not None:
            check_mask(mask, scene.seen)
    return scene, mask


def is_canonical(path: Path) -> bool:
    """Returns whether a file says that its object lies as the model's shapes do: an `.npz` with `frame` "canonical"."""
    if not is_zipfile(path):  # NumPy would read all of an NPY
        return False
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return "frame" in arrays.files and str(arrays["frame"]) == CANONICAL
    except (OSError, EOFError, ValueError, BadZipFile):
        return False  # whoever reads it says what is wrong


def save_view(path: Path, view: View) -> None:
    """Writes a view of a shape in the unit sphere as `OBSERVATION.npz`."""
    arrays = {"depth": view.depth, "intrinsics": view.camera.intrinsics, "T_world_camera": view.camera.T_world_camera}
    arrays |= {name: image for name, image in (("mask", view.mask), ("normal", view.normal)) if image is not None}
    save_arrays(path, arrays, {"frame": CANONICAL})
