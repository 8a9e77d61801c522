"""Meshes with what they look like: images on them, or colours.

What a mesh looks like is the file's own where images cover enough of it, else ours: a noise in space that modulates
its plain colours, so that there is something to match between views.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from distrace.data.ac3d import Surfaces, load_surfaces
from distrace.data.solid import bounding, normalised_frame, turn_matrix
from distrace.errors import explained
from experiments.clips.solid_texture import mottled

ENOUGH = 0.25  # of the area under images that are not of one colour
EDGE = 0.02  # triangles are split to this before they are coloured at their corners
FAR = 1e4  # repetitions of an image: uv beyond are garbage, which Mitsuba's filter turns into infinite colours
GREY = np.full(3, 0.6)


@dataclass(frozen=True)
class Patch:
    """Triangles that look alike: in one colour, or with an image, or with a colour at each corner."""

    corners: Float[np.ndarray, "triangles 3 3"]
    uv: Float[np.ndarray, "triangles 3 2"]  # v up
    colours: Float[np.ndarray, "triangles 3 3"]  # sRGB, 0 to 1; where there is no image
    image: UInt8[np.ndarray, "height width 3"] | None = None

    def chosen(self, triangles: Bool[np.ndarray, "triangles"]) -> "Patch":
        return replace(self, corners=self.corners[triangles], uv=self.uv[triangles], colours=self.colours[triangles])

    @property
    def area(self) -> float:
        return _soup([self]).area


def load_patches(path: Path) -> list[Patch]:
    """All triangles of a file, as they are. Raises `ValueError` for a file that cannot be read."""
    with explained(f"{path} cannot be read as a triangle mesh; give an OBJ, PLY, STL, OFF, GLB or AC file"):
        return _of_ac3d(path) if path.suffix.lower() == ".ac" else _of_trimesh(path)


def has_images(patches: Sequence[Patch]) -> bool:
    """Whether enough of a mesh is under images to tell its places apart by."""
    own = sum(patch.area for patch in patches if patch.image is not None)
    return bool(own > ENOUGH * sum(patch.area for patch in patches))


def placed(patches: Sequence[Patch], degrees: float) -> list[Patch]:
    """In the frame of `solid_of`: centred, scaled and turned alike. What bounds nothing of the solid is left out."""
    middle, scale = normalised_frame(_soup(patches))
    rotation = turn_matrix(degrees)[:3, :3]
    moved = [replace(patch, corners=(patch.corners - middle) * scale) for patch in patches]
    moved = [patch.chosen(_soup([patch]).area_faces > 1e-14) for patch in moved]
    kept = np.split(bounding(_soup(moved)), np.cumsum([len(patch.corners) for patch in moved])[:-1])
    seen = (patch.chosen(keep) for patch, keep in zip(moved, kept) if keep.any())
    return [replace(patch, corners=patch.corners @ rotation.T) for patch in seen]


def painted(patch: Patch, seed: int) -> Patch:
    """The patch in a texture of ours: its colours, or its image's mean, mottled."""
    base = patch.colours if patch.image is None else np.broadcast_to(_mean(patch.image), patch.colours.shape)
    corners = patch.corners.reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    finer: Any = trimesh.remesh.subdivide_to_size(corners, faces, EDGE, max_iter=20, return_index=True)
    vertices, split, index = finer
    points = np.asarray(vertices)[split]
    flat = base[index].mean(1, keepdims=True).repeat(3, axis=1)
    colours = mottled(points.reshape(-1, 3), flat.reshape(-1, 3), seed).reshape(points.shape)
    return Patch(points, np.zeros((*points.shape[:2], 2)), colours)


def _soup(patches: Sequence[Patch]) -> trimesh.Trimesh:
    corners = np.concatenate([patch.corners for patch in patches]).reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def _of_trimesh(path: Path) -> list[Patch]:
    scene: Any = trimesh.load(path, force="scene", process=False)
    return [_of_geometry(mesh) for mesh in scene.dump()]


def _of_geometry(mesh: Any) -> Patch:
    material, uv = getattr(mesh.visual, "material", None), getattr(mesh.visual, "uv", None)
    colour = GREY if material is None else np.asarray(material.main_color[:3]) / 255
    image = getattr(material, "image", None)
    corners = np.asarray(mesh.triangles, np.float64)
    if uv is None or image is None:
        return _patch(corners, np.zeros((*corners.shape[:2], 2)), colour, None)
    return _patch(corners, np.asarray(uv)[mesh.faces], colour, _pixels(image))


def _of_ac3d(path: Path) -> list[Patch]:
    colours, found = load_surfaces(path)
    images = sorted({surfaces.image for surfaces in found})
    alike = [_joined([surfaces for surfaces in found if surfaces.image == image]) for image in images]
    return [patch for surfaces in alike for patch in _of_surfaces(surfaces, colours, path.parent)]


def _joined(parts: Sequence[Surfaces]) -> Surfaces:
    corners, uv, material = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "uv", "material")
    )
    return Surfaces(corners, uv, material, parts[0].image)


def _of_surfaces(surfaces: Surfaces, colours: Float[np.ndarray, "materials 3"], folder: Path) -> Iterator[Patch]:
    file = folder / surfaces.image
    if surfaces.image and file.is_file():
        yield _patch(surfaces.corners, surfaces.uv, GREY, _pixels(Image.open(file)))
        return
    for material in np.unique(surfaces.material):
        its = surfaces.material == material
        yield _patch(surfaces.corners[its], surfaces.uv[its], colours[material], None)


def _patch(
    corners: Float[np.ndarray, "n 3 3"], uv: Float[np.ndarray, "n 3 2"], colour: Float[np.ndarray, "3"], image: Any
) -> Patch:
    """An image of one colour, as painters use them, is that colour; and no place in an image is far off it."""
    if image is not None and np.ptp(image.reshape(-1, 3), axis=0).max() < 8:
        colour, image = _mean(image), None
    return Patch(corners, np.where(np.abs(uv) < FAR, uv, 0.0), np.broadcast_to(colour, corners.shape), image)


def _mean(image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "3"]:
    return image.reshape(-1, 3).mean(0) / 255


def _pixels(image: Any) -> UInt8[np.ndarray, "height width 3"]:
    return np.asarray(image.convert("RGBA").convert("RGB"))  # by way of RGBA: some palettes have transparent colours
