"""Classical stereo, to compare with: points of an object from its photographs alone, pair by pair.

Each view is rectified with its neighbours and matched by semi-global matching (Hirschmüller, PAMI 2008), in OpenCV's
implementation. Points that no other pair of views confirms are dropped. Nothing is known of what the object may be.
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
from distrace.errors import explained
from distrace.photos.stereo_pairs import neighbour_views

PARTNERS = 2  # of each view
LARGER = 2  # times: matches are found to about a sixteenth of a pixel only where images are smooth
BLOCK = 5  # pixels across, that are compared
SMALL, LARGE = 8 * 3 * BLOCK**2, 32 * 3 * BLOCK**2  # penalties of disparities that change by one, or by more
UNIQUE = 10  # per cent by which the best match must beat the next
SPECKLE = 60  # pixels of even disparity that a region needs
PLAIN = 3.0  # grey levels: where the standard deviation of a block is less, nothing is to be matched
CELL = 0.01  # radii: a pair has one point in a cell of this size
CONFIRMED = 0.02  # radii: a point has another pair's point as near as that …
CONFIRMATIONS = 2  # … of so many other pairs


@dataclass(frozen=True)
class Rectified:
    """Two views turned about their eyes so that a point lies in the same row of both images."""

    camera: Camera  # of the first
    images: tuple[np.ndarray, np.ndarray]
    baseline: float
    offset: float  # a point's disparity less what its depth gives: f · baseline / z

    @staticmethod
    def of(first: Photograph, second: Photograph) -> "Rectified":
        """Both images' middles see the origin; so the disparity of the origin is zero."""
        poses = [each.camera.T_world_camera.double() for each in (first, second)]
        apart = poses[1][:3, 3] - poses[0][:3, 3]
        right = apart / apart.norm()
        forward = -(poses[0][:3, 3] + poses[1][:3, 3])
        forward = torch.nn.functional.normalize(forward - (forward @ right) * right, dim=0)
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
        size = LARGER * max(first.camera.height, first.camera.width)
        focal = LARGER * float(first.camera.intrinsics[0, 0])
        cameras = [_turned(pose[:3, 3], rotation, focal, size) for pose in poses]
        images = tuple(_warped(each, camera) for each, camera in zip((first, second), cameras, strict=True))
        offset = float(cameras[0].intrinsics[0, 2] - cameras[1].intrinsics[0, 2])
        assert len(images) == 2
        return Rectified(cameras[0], images, float(apart.norm()), offset)

    def points(self) -> Float[Tensor, "n 3"]:
        """In the world and within the unit sphere, of pixels whose match is sure."""
        cv2 = _opencv()
        focal = float(self.camera.intrinsics[0, 0])
        away = float((self.camera.T_world_camera[:3, 3]).norm())
        least, most = (focal * self.baseline / depth + self.offset for depth in (away + 1, max(away - 1, away / 4)))
        start, count = int(np.floor(least)), 16 * max(1, int(np.ceil((most - least) / 16)))
        matcher = cv2.StereoSGBM.create(
            start, count, BLOCK, SMALL, LARGE, 1, 0, UNIQUE, SPECKLE, 2, cv2.STEREO_SGBM_MODE_HH
        )
        disparity = torch.from_numpy(matcher.compute(*self.images).astype(np.float64) / 16)
        found = (disparity >= start) & torch.from_numpy(_contrast(self.images[0]) > PLAIN)
        depth = focal * self.baseline / (disparity[found] - self.offset)
        rays = self.camera.rays(self.camera.pixels()[found])
        along = (rays.directions @ self.camera.T_world_camera[:3, 2]).clamp_min(1e-6)
        points = rays.at(depth / along)
        return _thinned(points[(points.norm(dim=-1) < 1) & (depth > 0)])


def stereo_points(photographs: Sequence[Photograph]) -> Float[np.ndarray, "n 3"]:
    """Points in the unit sphere that at least three pairs of views agree on.

    Raises `ValueError` where there are none, or without OpenCV.
    """
    clouds = [pair.points().numpy() for pair in _pairs(photographs)]
    trees = [KDTree(cloud) if len(cloud) else None for cloud in clouds]
    kept = [_confirmed(cloud, [*trees[:number], *trees[number + 1 :]]) for number, cloud in enumerate(clouds)]
    points = np.concatenate(kept)
    if not len(points):
        raise ValueError(f"no point of {len(photographs)} views was found by three pairs of them")
    return points


def _pairs(photographs: Sequence[Photograph]) -> Iterator[Rectified]:
    for number, others in enumerate(neighbour_views([each.camera for each in photographs], PARTNERS).tolist()):
        for other in others:
            if other >= 0:
                yield Rectified.of(photographs[number], photographs[other])


def _confirmed(cloud: np.ndarray, trees: Sequence[KDTree | None]) -> np.ndarray:
    count = np.zeros(len(cloud), dtype=int)
    for tree in trees:
        if tree is not None and len(cloud):
            count += np.isfinite(tree.query(cloud, distance_upper_bound=CONFIRMED)[0])
    return cloud[count >= CONFIRMATIONS]


def _turned(eye: Tensor, rotation: Tensor, focal: float, size: int) -> Camera:
    """A camera of that orientation whose image's middle column sees the origin."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, eye
    origin = -(rotation.T @ eye)
    middle = size / 2 - focal * origin[:2] / origin[2]
    matrix = torch.tensor([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]], dtype=torch.float64)
    return Camera(matrix, pose, size, size)


def _warped(photograph: Photograph, camera: Camera) -> np.ndarray:
    """What the turned camera sees; the photograph's pixels' middles lie at half numbers."""
    cv2, old = _opencv(), photograph.camera
    turn = camera.T_world_camera[:3, :3].T @ old.T_world_camera[:3, :3].double()
    moved = camera.intrinsics @ turn @ torch.linalg.inv(old.intrinsics.double())
    half = torch.tensor([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], dtype=torch.float64)
    matrix = (torch.linalg.inv(half) @ moved @ half).numpy()
    image = (255 * photograph.image.clamp(0, 1)).round().byte().numpy()
    size = (camera.width, camera.height)
    return cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _contrast(image: np.ndarray) -> np.ndarray:
    """The standard deviation of brightness about each pixel."""
    grey, size = image.mean(-1, dtype=np.float64), 2 * BLOCK + 1
    mean, squares = uniform_filter(grey, size), uniform_filter(grey**2, size)
    return np.sqrt(np.maximum(squares - mean**2, 0))


def _thinned(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """One point of each cell."""
    _, first = np.unique((points / CELL).floor().numpy(), axis=0, return_index=True)
    return points[torch.from_numpy(first)]


def _opencv() -> Any:
    """The library. Raises `ValueError` where it is not installed."""
    with explained(
        "classical stereo needs OpenCV, which is not installed; `pip install 'distrace[clips]'` installs it"
    ):
        return importlib.import_module("cv2")
