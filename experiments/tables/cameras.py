"""Cameras that were found, compared with given ones up to a similarity."""

from collections.abc import Mapping
from dataclasses import dataclass

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera


@dataclass(frozen=True)
class CameraErrors:
    """Errors of each camera, after a rotation that aligns the orientations, and a scale and shift of the centres."""

    degrees: Float[Tensor, "views"]
    percent: Float[Tensor, "views"]  # of the mean distance between the given centres and their middle
    focal_percent: Float[Tensor, "views"]

    def row(self) -> dict[str, float]:
        """Returns medians and maxima."""
        row: dict[str, float] = {}
        for name, values in (("rotation_{}_degrees", self.degrees), ("centre_{}_percent", self.percent)):
            row[name.format("median")] = round(values.quantile(0.5).item(), 3)
            row[name.format("max")] = round(values.max().item(), 3)
        return row | {"focal_median_percent": round(self.focal_percent.quantile(0.5).item(), 2)}


def camera_errors(found: Mapping[str, Camera], given: Mapping[str, Camera]) -> CameraErrors:
    """Compares the cameras of the same names. Raises `KeyError` where one that was found was not given."""
    poses = torch.stack([camera.T_world_camera.double() for camera in found.values()])
    given_poses = torch.stack([given[name].T_world_camera.double() for name in found])
    rotations = poses[:, :3, :3]
    given_rotations = given_poses[:, :3, :3]
    aligning = roma.special_procrustes((given_rotations @ rotations.mT).sum(0))
    radians = roma.rotmat_geodesic_distance(aligning @ rotations, given_rotations)
    centres = (poses[:, :3, 3] - poses[:, :3, 3].mean(0)) @ aligning.T
    given_centres = given_poses[:, :3, 3] - given_poses[:, :3, 3].mean(0)
    scale = (centres * given_centres).sum() / centres.square().sum()
    shifts = (scale * centres - given_centres).norm(dim=-1) / given_centres.norm(dim=-1).mean()
    focals = [(camera.intrinsics[0, 0] / given[name].intrinsics[0, 0]).double() for name, camera in found.items()]
    return CameraErrors(radians.rad2deg(), 100 * shifts, 100 * (torch.stack(focals) - 1).abs())
