"""The page of `cameras`: where the photographs were taken, and the points that they see."""

from collections import Counter
from typing import Any

import numpy as np

from distrace.report.page import facts_section, page
from distrace.report.scene import space_section

SIZE = 0.04  # of a drawn camera, in distances from the middle of the points
CORNERS = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float)  # of an image, in its camera's axes
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 3, 2], [1, 4, 3]])
POINTS_SHOWN = 0.98  # of the points, those nearest to the middle


def cameras_page(model: Any, photographs: int, origin: str) -> str:
    """Returns a page about a reconstruction of COLMAP's from so many photographs."""
    import trimesh

    poses = np.array([image.cam_from_world().inverse().matrix() for image in model.images.values() if image.has_pose])
    points = np.array([point.xyz for point in model.points3D.values()])
    middle = np.median(points, axis=0)
    distance = np.linalg.norm(points - middle, axis=1)
    near = points[distance <= np.quantile(distance, POINTS_SHOWN)]
    size = SIZE * float(np.median(np.linalg.norm(poses[:, :, 3] - middle, axis=1)))
    corners = np.concatenate([_pyramid(pose, size) for pose in poses])
    faces = (FACES + 5 * np.arange(len(poses))[:, None, None]).reshape(-1, 3)
    cameras = trimesh.Trimesh(corners, faces, process=False)
    lead = f"{len(poses)} of {photographs} photographs placed, with {len(points):,} points."
    lengths = Counter(point.track.length() for point in model.points3D.values())
    mean_length = sum(length * count for length, count in lengths.items()) / max(1, len(points))
    facts = {
        "Reprojection error, mean": f"{model.compute_mean_reprojection_error():.2f} pixels",
        "Photographs that see a point, mean": f"{mean_length:.1f}",
    }
    for camera in model.cameras.values():
        focal = f"focal length {camera.mean_focal_length():.0f} pixels"
        facts[f"Camera {camera.camera_id}"] = f"{camera.width} × {camera.height}, {focal}"
    return page("Cameras", lead, [space_section({"Cameras": cameras}, {"Points": near}), facts_section(facts)], origin)


def _pyramid(pose: np.ndarray, size: float) -> np.ndarray:
    """Returns centre and corners of a drawn camera in the world."""
    corners = size * CORNERS * [1, 0.75, 1.5]
    return np.concatenate([pose[None, :, 3], corners @ pose[:, :3].T + pose[:, 3]])
