"""Noise on the colours of meshes without images, so that views can be matched."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh

from distrace.data.patches import Patch, mean_colour
from experiments.clips.solid_texture import mottled

LEAST_TEXTURED = 0.25  # share of the area under images of more than one colour
EDGE = 0.02  # radii: triangles are split to this before their corners are coloured


def has_images(patches: Sequence[Patch]) -> bool:
    """Whether images cover enough of a mesh to match views."""
    textured = sum(patch.area for patch in patches if patch.image is not None)
    return bool(textured > LEAST_TEXTURED * sum(patch.area for patch in patches))


def mottled_patch(patch: Patch, seed: int) -> Patch:
    """Returns the patch with noise on its colours, or on its image's mean."""
    base = patch.colours if patch.image is None else np.broadcast_to(mean_colour(patch.image), patch.colours.shape)
    corners = patch.corners.reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    finer: Any = trimesh.remesh.subdivide_to_size(corners, faces, EDGE, max_iter=20, return_index=True)
    vertices, split, index = finer
    points = np.asarray(vertices)[split]
    flat = base[index].mean(1, keepdims=True).repeat(3, axis=1)
    colours = mottled(points.reshape(-1, 3), flat.reshape(-1, 3), seed).reshape(points.shape)
    return Patch(points, np.zeros((*points.shape[:2], 2)), colours)
