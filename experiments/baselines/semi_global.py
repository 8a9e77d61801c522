"""Classical stereo as a baseline: points of an object from its photographs alone, pair by pair.

Each view is rectified with its neighbours and matched by OpenCV's semi-global matching (Hirschmüller, PAMI 2008).
Points that fewer than two other pairs confirm are dropped. The method has no prior of the object's class.
"""

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import uniform_filter
from scipy.spatial import KDTree
from torch import Tensor

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.errors import error_context
from distrace.photos.stereo_pairs import neighbour_views

PARTNERS = 2  # of each view
UPSCALING = 2  # subpixel matches need smooth images
BLOCK = 5  # pixels across, of the matched windows
SMALL_PENALTY = 8 * 3 * BLOCK**2  # of disparities that change by one
LARGE_PENALTY = 32 * 3 * BLOCK**2  # of disparities that change by more
UNIQUENESS = 10  # per cent by which the best match must beat the next
SPECKLE = 60  # pixels of the smallest region of even disparity
LEAST_CONTRAST = 3.0  # grey levels, the standard deviation of a block; less cannot be matched
CELL = 0.01  # radii: a pair keeps one point in a cell
CONFIRMED = 0.02  # radii to the nearest point of another pair, for a confirmation
CONFIRMATIONS = 2  # by other pairs, that a point needs


@dataclass(frozen=True)
class Rectified:
    """Two views rotated about their centres so that a point lies in the same row of both images."""

    camera: Camera  # of the first
    images: tuple[np.ndarray, np.ndarray]
    baseline: float
    offset: float  # disparity − f · baseline / z

    @staticmethod
    def of(first: Photograph, second: Photograph) -> "Rectified":
        """Rectifies two views. The origin is in the middle of both images, so its disparity is zero."""
        poses = [each.camera.T_world_camera.double() for each in (first, second)]
        baseline = poses[1][:3, 3] - poses[0][:3, 3]
        right = baseline / baseline.norm()
        forward = -(poses[0][:3, 3] + poses[1][:3, 3])
        forward = torch.nn.functional.normalize(forward - (forward @ right) * right, dim=0)
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
        size = UPSCALING * max(first.camera.height, first.camera.width)
        focal = UPSCALING * float(first.camera.intrinsics[0, 0])
        cameras = [_rotated_camera(pose[:3, 3], rotation, focal, size) for pose in poses]
        images = tuple(_warped(each, camera) for each, camera in zip((first, second), cameras, strict=True))
        offset = float(cameras[0].intrinsics[0, 2] - cameras[1].intrinsics[0, 2])
        assert len(images) == 2
        return Rectified(cameras[0], images, float(baseline.norm()), offset)

    def points(self) -> Float[Tensor, "n 3"]:
        """Returns the points of matched pixels, in the world and within the unit sphere."""
        cv2 = _opencv()
        focal = float(self.camera.intrinsics[0, 0])
        distance = float((self.camera.T_world_camera[:3, 3]).norm())
        least, most = (
            focal * self.baseline / depth + self.offset for depth in (distance + 1, max(distance - 1, distance / 4))
        )
        start = int(np.floor(least))
        count = 16 * max(1, int(np.ceil((most - least) / 16)))
        matcher = cv2.StereoSGBM.create(
            start, count, BLOCK, SMALL_PENALTY, LARGE_PENALTY, 1, 0, UNIQUENESS, SPECKLE, 2, cv2.STEREO_SGBM_MODE_HH
        )
        disparity = torch.from_numpy(matcher.compute(*self.images).astype(np.float64) / 16)
        matched = (disparity >= start) & torch.from_numpy(_contrast(self.images[0]) > LEAST_CONTRAST)
        depth = focal * self.baseline / (disparity[matched] - self.offset)
        rays = self.camera.rays(self.camera.pixels()[matched])
        along = (rays.directions @ self.camera.T_world_camera[:3, 2]).clamp_min(1e-6)
        points = rays.at(depth / along)
        return _one_per_cell(points[(points.norm(dim=-1) < 1) & (depth > 0)])


def stereo_points(photographs: Sequence[Photograph]) -> Float[np.ndarray, "n 3"]:
    """Returns points in the unit sphere that at least three pairs of views agree on.

    Raises `ValueError` without such points, or without OpenCV.
    """
    clouds = [pair.points().numpy() for pair in _pairs(photographs)]
    trees = [KDTree(cloud) if len(cloud) else None for cloud in clouds]
    confirmed = [_confirmed(cloud, [*trees[:number], *trees[number + 1 :]]) for number, cloud in enumerate(clouds)]
    points = np.concatenate(confirmed)
    if not len(points):
        raise ValueError(f"no three pairs of the {len(photographs)} views agree on a point")
    return points


def _pairs(photographs: Sequence[Photograph]) -> Iterator[Rectified]:
    for number, neighbours in enumerate(neighbour_views([each.camera for each in photographs], PARTNERS).tolist()):
        for neighbour in neighbours:
            if neighbour >= 0:
                yield Rectified.of(photographs[number], photographs[neighbour])


def _confirmed(cloud: np.ndarray, trees: Sequence[KDTree | None]) -> np.ndarray:
    count = np.zeros(len(cloud), dtype=int)
    for tree in trees:
        if tree is not None and len(cloud):
            count += np.isfinite(tree.query(cloud, distance_upper_bound=CONFIRMED)[0])
    return cloud[count >= CONFIRMATIONS]


def _rotated_camera(eye: Tensor, rotation: Tensor, focal: float, size: int) -> Camera:
    """Returns a camera of that orientation with the origin in the middle of its image."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, eye
    origin = -(rotation.T @ eye)
    middle = size / 2 - focal * origin[:2] / origin[2]
    matrix = torch.tensor([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]], dtype=torch.float64)
    return Camera(matrix, pose, size, size)


def _warped(photograph: Photograph, camera: Camera) -> np.ndarray:
    """Warps a photograph to the rotated camera; pixel centres are at half-integers."""
    cv2 = _opencv()
    old = photograph.camera
    turn = camera.T_world_camera[:3, :3].T @ old.T_world_camera[:3, :3].double()
    moved = camera.intrinsics @ turn @ torch.linalg.inv(old.intrinsics.double())
    half = torch.tensor([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], dtype=torch.float64)
    matrix = (torch.linalg.inv(half) @ moved @ half).numpy()
    image = (255 * photograph.image.clamp(0, 1)).round().byte().numpy()
    size = (camera.width, camera.height)
    return cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _contrast(image: np.ndarray) -> np.ndarray:
    """Returns the standard deviation of brightness around each pixel."""
    grey = image.mean(-1, dtype=np.float64)
    size = 2 * BLOCK + 1
    variance = uniform_filter(grey**2, size) - uniform_filter(grey, size) ** 2
    return np.sqrt(np.maximum(variance, 0))


def _one_per_cell(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """Returns one point of each cell."""
    _, first = np.unique((points / CELL).floor().numpy(), axis=0, return_index=True)
    return points[torch.from_numpy(first)]


def _opencv() -> Any:
    """Imports OpenCV. Raises `ValueError` where it is not installed."""
    with error_context(
        "classical stereo needs OpenCV, which is not installed; `pip install 'distrace[clips]'` installs it"
    ):
        return importlib.import_module("cv2")
