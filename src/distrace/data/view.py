"""One observed view: a camera and what it saw. The file form is `OBSERVATION.npz`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.solid import Solid
from distrace.errors import explained
from distrace.files import save_arrays
from distrace.shading import Picture, shaded_picture


@dataclass(frozen=True)
class View:
    """Depth z in the units of the unit sphere, `inf` where there is none; the mask, if known, says what is object."""

    camera: Camera
    depth: Float[Tensor, "height width"]
    mask: Bool[Tensor, "height width"] | None = None
    normal: Float[Tensor, "height width 3"] | None = None

    @property
    def seen(self) -> Bool[Tensor, "height width"]:
        """Where there is a depth."""
        return torch.isfinite(self.depth)

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

    def sparse(self, count: int, seed: int = 0) -> "View":
        """The same view with only `count` of its depths, drawn at random."""
        chosen = torch.randperm(int(self.seen.sum()), generator=torch.Generator().manual_seed(seed))[:count]
        kept = self.seen.nonzero()[chosen]
        depth = torch.full_like(self.depth, torch.inf)
        depth[kept[:, 0], kept[:, 1]] = self.depth[kept[:, 0], kept[:, 1]]
        return replace(self, depth=depth)


def load_view(path: Path) -> View:
    """Reads `OBSERVATION.npz`. Raises `ValueError`, in one sentence, for what is missing or makes no sense."""
    with explained(f"{path} is not an observation: an .npz with depth, intrinsics and T_world_camera"):
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        depth = torch.from_numpy(arrays["depth"].astype(np.float32))
        intrinsics = torch.from_numpy(arrays["intrinsics"].astype(np.float32))
        pose = torch.from_numpy(arrays["T_world_camera"].astype(np.float32))
    if depth.dim() != 2:
        raise ValueError(f"{path}: depth has shape {list(depth.shape)}; an image [height, width] is needed")
    with explained(f"{path} describes no camera"):
        camera = Camera.from_matrices(intrinsics, pose, *depth.shape)
    depth = torch.where(torch.isfinite(depth) & (depth > 0), depth, torch.inf)
    view = View(camera, depth, _image(arrays, "mask", path, depth.shape), _image(arrays, "normal", path, depth.shape))
    _check_units(view, path)
    return view


def save_view(path: Path, view: View) -> None:
    arrays = {"depth": view.depth, "intrinsics": view.camera.intrinsics, "T_world_camera": view.camera.T_world_camera}
    arrays |= {name: image for name, image in (("mask", view.mask), ("normal", view.normal)) if image is not None}
    save_arrays(path, arrays)


def observe(solid: Solid, camera: Camera) -> View:
    """What the camera sees of a mesh's outer surface, by Embree's ray casting: nothing of ours but the camera."""
    rays = camera.rays()
    origins, directions = rays.origins.reshape(-1, 3).numpy(), rays.directions.reshape(-1, 3).numpy()
    cast: Any = solid.surface.ray.intersects_id
    faces, pixels, points = cast(origins, directions, multiple_hits=False, return_locations=True)
    _, depths = camera.project(torch.from_numpy(points).float())
    depth = torch.full((camera.height * camera.width,), torch.inf)
    depth[pixels] = depths
    normal = torch.zeros(len(depth), 3)
    normal[pixels] = torch.from_numpy(solid.surface.face_normals[faces]).float()
    shape = (camera.height, camera.width)
    depth = depth.reshape(shape)
    return View(camera, depth, torch.isfinite(depth), normal.reshape(*shape, 3))


def _image(arrays: dict[str, np.ndarray], name: str, path: Path, shape: torch.Size) -> Tensor | None:
    if name not in arrays:
        return None
    wanted = [*shape, 3] if name == "normal" else list(shape)
    if list(arrays[name].shape) != wanted:
        raise ValueError(f"{path}: {name} has shape {list(arrays[name].shape)}; beside this depth it must be {wanted}")
    return torch.from_numpy(arrays[name].astype(np.float32 if name == "normal" else bool))


def _check_units(view: View, path: Path) -> None:
    if not view.seen.any() and (view.mask is None or not view.mask.any()):
        raise ValueError(f"{path} shows nothing: no depth is finite and positive, and no pixel is marked as object")
    farthest = view.points().norm(dim=-1).median() if view.seen.any() else torch.tensor(0.0)
    if farthest > 3:
        raise ValueError(
            f"{path}: its points lie {farthest:.3g} from the origin, in the median; depth must be in the units of the"
            " unit sphere that holds the shape (metres or millimetres need scaling, and T_world_camera with them)"
        )
