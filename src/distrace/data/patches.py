"""Meshes with their appearance: images, or colours at their corners."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from distrace.data.ac3d import Surfaces, load_surfaces
from distrace.data.solid import bounding, normalised_frame, turn_matrix
from distrace.errors import error_context

if TYPE_CHECKING:
    import trimesh

LARGEST_UV = 1e4  # repetitions of an image; garbage beyond becomes infinite in Mitsuba's filter
GREY = np.full(3, 0.6)


@dataclass(frozen=True)
class Patch:
    """Triangles that share an appearance: an image, or a colour at each corner."""

    corners: Float[np.ndarray, "triangles 3 3"]
    uv: Float[np.ndarray, "triangles 3 2"]  # v up
    colours: Float[np.ndarray, "triangles 3 3"]  # sRGB, 0 to 1; used without an image
    image: UInt8[np.ndarray, "height width 3"] | None = None

    def chosen(self, triangles: Bool[np.ndarray, "triangles"]) -> "Patch":
        return replace(self, corners=self.corners[triangles], uv=self.uv[triangles], colours=self.colours[triangles])

    @property
    def area(self) -> float:
        return _soup([self]).area

    def colours_at(self, triangle: Int[np.ndarray, "n"], weights: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Returns sRGB colours at barycentric coordinates; an image repeats, and its nearest pixel counts."""
        if self.image is None:
            return np.einsum("nk,nkc->nc", weights, self.colours[triangle])
        height, width = self.image.shape[:2]
        u, v = np.einsum("nk,nkd->dn", weights, self.uv[triangle]) % 1.0
        row = ((1 - v) * height).astype(int).clip(0, height - 1)
        column = (u * width).astype(int).clip(0, width - 1)
        return self.image[row, column] / 255


def load_patches(path: Path) -> list[Patch]:
    """Returns all triangles of a file. Raises `ValueError` for a file that cannot be read."""
    with error_context(f"{path} cannot be read as a triangle mesh; give an OBJ, PLY, STL, OFF, GLB or AC file"):
        return _of_ac3d(path) if path.suffix.lower() == ".ac" else _of_trimesh(path)


def in_unit_sphere(patches: Sequence[Patch], degrees: float) -> list[Patch]:
    """Returns the patches in the frame of their solid, turned about y."""
    middle, scale = normalised_frame(_soup(patches))
    rotation = turn_matrix(degrees)[:3, :3]
    return [replace(patch, corners=(patch.corners - middle) * scale @ rotation.T) for patch in patches]


def placed(patches: Sequence[Patch], degrees: float) -> list[Patch]:
    """Returns the patches in the frame of their turned solid, without the triangles that bound nothing of it."""
    moved = in_unit_sphere(patches, degrees)
    moved = [patch.chosen(_soup([patch]).area_faces > 1e-14) for patch in moved]
    masks = np.split(bounding(_soup(moved)), np.cumsum([len(patch.corners) for patch in moved])[:-1])
    return [patch.chosen(mask) for patch, mask in zip(moved, masks) if mask.any()]


def _soup(patches: Sequence[Patch]) -> "trimesh.Trimesh":
    import trimesh

    corners = np.concatenate([patch.corners for patch in patches]).reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def _of_trimesh(path: Path) -> list[Patch]:
    import trimesh

    scene: Any = trimesh.load(path, force="scene", process=False)
    return [_of_geometry(mesh) for mesh in scene.dump()]


def _of_geometry(mesh: Any) -> Patch:
    corners = np.asarray(mesh.triangles, np.float64)
    if mesh.visual.kind == "vertex":
        colours = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
        return Patch(corners, np.zeros((*corners.shape[:2], 2)), colours[mesh.faces])
    material = getattr(mesh.visual, "material", None)
    uv = getattr(mesh.visual, "uv", None)
    colour = GREY if material is None else np.asarray(material.main_color[:3]) / 255
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)  # of OBJ, of GLB
    if uv is None or image is None:
        return _patch(corners, np.zeros((*corners.shape[:2], 2)), colour, None)
    return _patch(corners, np.asarray(uv)[mesh.faces], colour, _pixels(image))


def _of_ac3d(path: Path) -> list[Patch]:
    colours, found = load_surfaces(path)
    images = sorted({surfaces.image for surfaces in found})
    by_image = [_joined([surfaces for surfaces in found if surfaces.image == image]) for image in images]
    return [patch for surfaces in by_image for patch in _of_surfaces(surfaces, colours, path.parent)]


def _joined(parts: Sequence[Surfaces]) -> Surfaces:
    corners, uv, material = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "uv", "material")
    )
    return Surfaces(corners, uv, material, parts[0].image)


def _of_surfaces(surfaces: Surfaces, colours: Float[np.ndarray, "materials 3"], folder: Path) -> Iterator[Patch]:
    from PIL import Image

    file = folder / surfaces.image
    if surfaces.image and file.is_file():
        yield _patch(surfaces.corners, surfaces.uv, GREY, _pixels(Image.open(file)))
        return
    for material in np.unique(surfaces.material):
        of_material = surfaces.material == material
        yield _patch(surfaces.corners[of_material], surfaces.uv[of_material], colours[material], None)


def _patch(
    corners: Float[np.ndarray, "n 3 3"], uv: Float[np.ndarray, "n 3 2"], colour: Float[np.ndarray, "3"], image: Any
) -> Patch:
    """Replaces an image of one colour by that colour, and garbage uv by zero."""
    if image is not None and np.ptp(image.reshape(-1, 3), axis=0).max() < 8:
        colour = mean_colour(image)
        image = None
    return Patch(corners, np.where(np.abs(uv) < LARGEST_UV, uv, 0.0), np.broadcast_to(colour, corners.shape), image)


def mean_colour(image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "3"]:
    return image.reshape(-1, 3).mean(0) / 255


def _pixels(image: Any) -> UInt8[np.ndarray, "height width 3"]:
    return np.asarray(image.convert("RGBA").convert("RGB"))  # through RGBA, since palettes may have transparent colours
