"""Pictures of a mesh without tracing a field: many points of its surface, of which each pixel shows the nearest."""

from typing import TYPE_CHECKING

import torch
from torch.nn.functional import normalize

from distrace.camera import Camera
from distrace.shading import WHITE, Picture, mean_light, shaded_picture

if TYPE_CHECKING:
    import trimesh

SAMPLES = 2  # along each side of a pixel
DENSITY = 10.0  # points on the surface before each of these samples, so that one in 20,000 stays empty
MOST_POINTS = 4_000_000


def mesh_picture(mesh: "trimesh.Trimesh", camera: Camera) -> Picture:
    """Returns the shaded mesh as the camera sees it; both in the same frame.

    >>> mesh_picture(trimesh.creation.box(), Camera.orbit(30, 20, 4, height=96, width=96)).shape
    (96, 96, 3)
    """
    fine = camera.to("cpu").float().resized(SAMPLES)
    points, normals = _surface_points(mesh, fine)
    nearest, _ = fine.nearest_points(points)
    mask = nearest >= 0
    normal = torch.zeros(*mask.shape, 3)
    normal[mask] = normals[nearest[mask]]
    return mean_light(shaded_picture(normal, mask, fine.rays().directions), mask, SAMPLES, WHITE)


def _surface_points(mesh: "trimesh.Trimesh", camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns points [n, 3] all over the surface that faces the camera, dense enough for it, and unit normals."""
    random = torch.Generator().manual_seed(0)
    vertices, normals, middles, facing, areas = (
        torch.tensor(values, dtype=torch.float32)
        for values in (mesh.vertices, mesh.vertex_normals, mesh.triangles_center, mesh.face_normals, mesh.area_faces)
    )
    areas = areas * (((camera.T_world_camera[:3, 3] - middles) * facing).sum(-1) > 0)
    total = float(areas.sum())
    if not total:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    _, depths = camera.project(vertices)
    nearest = depths.min().clamp_min(0.1 * depths.abs().max())
    pixel_width = float(nearest / camera.intrinsics[0, 0])
    count = min(int(DENSITY * total / pixel_width**2) + 1, MOST_POINTS)
    places = total * (torch.arange(count).double() + torch.rand(count, generator=random)) / count
    face = torch.searchsorted(areas.double().cumsum(0), places).clamp_max(len(areas) - 1)
    corners = torch.tensor(mesh.faces)[face]
    first, second = torch.rand(2, count, 1, generator=random)
    beyond = first + second > 1
    first = torch.where(beyond, 1 - first, first)
    second = torch.where(beyond, 1 - second, second)
    shares = torch.cat([1 - first - second, first, second], dim=1)
    points = torch.einsum("nk,nkj->nj", shares, vertices[corners])
    return points, normalize(torch.einsum("nk,nkj->nj", shares, normals[corners]), dim=-1)
