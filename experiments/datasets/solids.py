"""The solids of a split's shapes, and what a camera sees of one."""

from pathlib import Path
from typing import Any

import torch

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.data.shapes import Shape
from distrace.data.solid import Solid, load_solid, turned


def mesh_of(shape: Shape, meshes: Path) -> Path:
    """Returns a shape's file, in `meshes` or a folder in it. Raises `ValueError` where it is missing."""
    for path in (meshes / shape.path, *sorted(meshes.glob(f"*/{shape.path}"))):
        if path.is_file():
            return path
    raise ValueError(f"{meshes / shape.path} is missing; `distrace data furniture` and `… planes` fetch the meshes")


def solid_of(shape: Shape, meshes: Path) -> Solid:
    """A shape of a split as it is learnt. Raises `ValueError` where its mesh is missing, or as `load_solid` does."""
    return turned(load_solid(mesh_of(shape, meshes)), shape.turn)


def observe(solid: Solid, camera: Camera) -> View:
    """Returns what the camera sees of a mesh's outer surface, by Embree's ray casting."""
    rays = camera.rays()
    origins = rays.origins.reshape(-1, 3).numpy()
    directions = rays.directions.reshape(-1, 3).numpy()
    cast: Any = solid.surface.ray.intersects_id
    faces, pixels, points = cast(origins, directions, multiple_hits=False, return_locations=True)
    depth = torch.full((len(origins),), torch.inf)
    depth[pixels] = camera.project(torch.from_numpy(points).float())[1]
    normal = torch.zeros(len(origins), 3)
    normal[pixels] = torch.from_numpy(solid.surface.face_normals[faces]).float()
    depth = depth.reshape(camera.height, camera.width)
    return View(camera, depth, torch.isfinite(depth), normal.reshape(*depth.shape, 3))
