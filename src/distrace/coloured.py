"""Pictures and meshes of shapes with colours."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float

from distrace.boundary import shade
from distrace.colour_space import to_linear, to_srgb
from distrace.fields.colour import Albedo
from distrace.lights import Ambient, Directional, Light, lit
from distrace.render import Buffers
from distrace.shading import WHITE, Colour, Picture, colour_picture, key_light

if TYPE_CHECKING:
    import trimesh

AMBIENT = 0.45  # of the light that pictures have by default; the rest comes from one direction
MESH_CHUNK = 1 << 16  # vertices whose colours are found at a time


def studio(buffers: Buffers, direction: Float[np.ndarray, "3"] | None = None) -> list[Light]:
    """Returns white light from everywhere and from one direction, by default over the camera's left shoulder."""
    like = buffers.cosines
    towards = key_light(buffers.rays.directions) if direction is None else direction
    sun = Directional(torch.as_tensor(towards).to(like), like.new_full((3,), 1 - AMBIENT))
    return [Ambient(like.new_full((3,), AMBIENT)), sun]


@torch.no_grad()
def coloured_picture(buffers: Buffers, albedo: Albedo, lights: Sequence[Light], background: Colour = WHITE) -> Picture:
    """Returns the picture of a matt surface in lights, with one ray a pixel."""
    behind = to_linear(buffers.cosines.new_tensor(background) / 255)
    return colour_picture(to_srgb(shade(buffers, lit(albedo, lights), behind)).cpu())


@torch.no_grad()
def coloured_mesh(mesh: "trimesh.Trimesh", albedo: Albedo, device: torch.device | str = "cpu") -> "trimesh.Trimesh":
    """Returns a mesh in the unit sphere with the colours of its vertices."""
    import trimesh

    points = torch.from_numpy(np.array(mesh.vertices, np.float32)).to(device)
    normals = torch.from_numpy(np.array(mesh.vertex_normals, np.float32)).to(device)
    parts = zip(points.split(MESH_CHUNK), normals.split(MESH_CHUNK))
    colours = [to_srgb(albedo(*part)).cpu() for part in parts]
    if not colours:
        return mesh
    levels = (255 * torch.cat(colours).clamp(0, 1)).round().to(torch.uint8)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=levels.numpy(), process=False)
