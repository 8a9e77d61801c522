"""A scan on disk: what a completion was fitted to, so that it can be looked at, and fitted again."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from distrace.camera import Camera
from distrace.data.scan import Scan
from distrace.errors import error_context
from distrace.files import save_arrays
from distrace.rays import Rays


def save_scan(path: str | Path, scan: Scan) -> None:
    """Writes points, rays and cameras as `.npz`; depths are left out."""
    cameras = [view.camera for view in scan.views]
    arrays = {
        "points": scan.points,
        "free_origins": scan.free.origins,
        "free_directions": scan.free.directions,
        "free_until": scan.free_until,
        "hit_origins": scan.hits.origins,
        "hit_directions": scan.hits.directions,
        "ups": scan.ups,
        "noise_and_tilt": torch.tensor([scan.noise, scan.tilt]),
        "intrinsics": _stacked([camera.intrinsics for camera in cameras], 3),
        "T_world_camera": _stacked([camera.T_world_camera for camera in cameras], 4),
        "sizes": torch.tensor([[camera.height, camera.width] for camera in cameras]).reshape(-1, 2),
    }
    save_arrays(path, arrays)


def read_scan(path: str | Path) -> tuple[Scan, list[Camera]]:
    """Reads what `save_scan` wrote. Raises `ValueError` for any other file."""
    path = Path(path)
    with error_context(f"{path} is no scan that `complete` wrote", path):
        with np.load(path, allow_pickle=False) as file:
            content = {name: torch.from_numpy(file[name]) for name in file.files}
        noise, tilt = content["noise_and_tilt"].tolist()
        free = Rays(content["free_origins"], content["free_directions"])
        hits = Rays(content["hit_origins"], content["hit_directions"])
        scan = Scan(content["points"], free, content["free_until"], hits, noise, content["ups"], tilt)
        described = zip(content["intrinsics"], content["T_world_camera"], content["sizes"].tolist(), strict=True)
        cameras = [Camera.from_matrices(inner, pose, *size) for inner, pose, size in described]
    return scan, cameras


def _stacked(matrices: list[Tensor], size: int) -> Tensor:
    return torch.stack([each.cpu() for each in matrices]) if matrices else torch.empty(0, size, size)
