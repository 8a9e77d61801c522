"""Photometric consistency of patches between views, through the surface.

While the surface is off by more than a pixel, a learnt texture is blurred and says little about the shape. Patches of
two photographs need no texture (Darmon et al., *NeuralWarp*, CVPR 2022; Fu et al., *Geo-NeuS*, NeurIPS 2022).
Normalised cross-correlation makes them independent of the light. Patches on the tangent plane, as there, would shrink
round objects, since the plane lies outside; so each of their pixels goes on to the surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import cosine_similarity

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF
from distrace.photos.stereo_pairs import neighbour_views

PATCH_WIDTH = 5  # pixels
NEIGHBOURS = 4  # views that each is compared with, …
BEST_NEIGHBOURS = 2  # … and those that count: the others may be occluded
LEAST_COSINE = 0.5  # between a normal and the direction to an eye: flatter patches would shrink the object
LEAST_VARIANCE = 1e-4  # of brightness: a patch with less says nothing


@dataclass(frozen=True)
class PatchMatching:
    """Photographs of any sizes in one row of pixels, their cameras, and the neighbours to compare them with."""

    brightness: Float[Tensor, "pixels"]
    offsets: Int[Tensor, "views"]  # of each photograph in that row
    sizes: Int[Tensor, "views 2"]  # width and height
    intrinsics: Float[Tensor, "views 3 3"]
    T_camera_world: Float[Tensor, "views 4 4"]
    neighbours: Int[Tensor, "views count"]  # −1 where there are fewer

    @staticmethod
    def of(photographs: Sequence[Photograph], device: torch.device) -> "PatchMatching":
        cameras = [photograph.camera for photograph in photographs]
        sizes = torch.tensor([[camera.width, camera.height] for camera in cameras])
        parts = (
            torch.cat([photograph.image.mean(-1).reshape(-1) for photograph in photographs]),
            torch.cat([torch.zeros(1, dtype=torch.long), sizes.prod(1).cumsum(0)[:-1]]),
            sizes,
            torch.stack([camera.intrinsics for camera in cameras]),
            torch.linalg.inv(torch.stack([camera.T_world_camera for camera in cameras])),
            neighbour_views(cameras, NEIGHBOURS),
        )
        return PatchMatching(*(part.to(device) for part in parts))

    def moved(self, motions: Float[Tensor, "views 4 4"]) -> "PatchMatching":
        """The same with each view's camera moved; differentiable in the motions."""
        return replace(self, T_camera_world=self.T_camera_world @ torch.linalg.inv(motions))

    def loss(
        self,
        sdf: SDF,
        view: Int[Tensor, "n"],
        pixels: Float[Tensor, "n 2"],
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
    ) -> Float[Tensor, ""]:
        """The mean of 1 − correlation between each point's patch in its view and those in its best neighbours.

        Differentiable in points and normals; 0 where no patch can be compared.
        """
        neighbours = self.neighbours[view]
        row, column = (neighbours >= 0).nonzero().T
        other = neighbours[row, column]
        patch_points, patch = self._patches(sdf, view, pixels, points, normals)
        projected, depth = self._project(other, patch_points[row])
        usable = self._faces(other, points[row], normals[row]) & self._faces(view, points, normals)[row]
        inside = (projected > 0) & (projected < self.sizes[other][:, None])
        usable &= inside.all(-1).all(-1) & (depth > 0).all(-1)
        differences = 1 - correlation(patch[row], self._read(other, projected))
        by_neighbour = torch.full(neighbours.shape, torch.inf).to(points)
        by_neighbour = by_neighbour.index_put((row[usable], column[usable]), differences[usable])
        best = by_neighbour.topk(min(BEST_NEIGHBOURS, by_neighbour.shape[1]), dim=1, largest=False).values
        counted = best.isfinite()
        return torch.where(counted, best, 0.0).sum() / counted.sum().clamp_min(1)

    def _patches(
        self, sdf: SDF, view: Int[Tensor, "n"], pixels: Float[Tensor, "n 2"], points: Tensor, normals: Tensor
    ) -> tuple[Float[Tensor, "n patch 3"], Float[Tensor, "n patch"]]:
        """Surface points on the rays of the pixels around, and the brightness of these pixels.

        One Newton step from the tangent plane gives the points, differentiable in the plane. The step is at most the
        distance from the patch's centre.
        """
        steps = torch.arange(PATCH_WIDTH, device=pixels.device) - PATCH_WIDTH // 2
        around = pixels[:, None] + torch.cartesian_prod(steps, steps)
        homogeneous = torch.cat([around, torch.ones_like(around[..., :1])], dim=-1)
        rotation = self.T_camera_world[view, :3, :3]
        eyes = -(rotation.mT @ self.T_camera_world[view, :3, 3, None])[..., 0]
        directions = homogeneous @ (torch.linalg.inv(self.intrinsics[view]).mT @ rotation)
        height = ((points - eyes) * normals).sum(-1, keepdim=True)
        slope = (directions * normals[:, None]).sum(-1)
        slope = torch.where(slope.abs() < 1e-6, -1e-6, slope)
        on_plane = eyes[:, None] + (height / slope)[..., None] * directions
        with torch.no_grad():
            limit = (on_plane - points[:, None]).norm(dim=-1)
            value = torch.minimum(sdf(on_plane), limit).maximum(-limit)
        on_surface = on_plane - (value / slope.detach())[..., None] * directions.detach()
        return on_surface, self._read(view, around)

    def _project(
        self, view: Int[Tensor, "n"], points: Float[Tensor, "n patch 3"]
    ) -> tuple[Float[Tensor, "n patch 2"], Float[Tensor, "n patch"]]:
        """Pixel positions and depths, each row in a view of its own."""
        pose = self.T_camera_world[view]
        projected = (points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]) @ self.intrinsics[view].mT
        depth = projected[..., 2]
        return projected[..., :2] / torch.where(depth > 1e-6, depth, 1e-6)[..., None], depth

    def _faces(self, view: Int[Tensor, "n"], points: Tensor, normals: Tensor) -> Bool[Tensor, "n"]:
        pose = self.T_camera_world[view]
        eyes = -(pose[:, :3, :3].mT @ pose[:, :3, 3:])[..., 0]
        return cosine_similarity(eyes - points, normals, dim=-1) > LEAST_COSINE

    def _read(self, view: Int[Tensor, "n"], pixels: Float[Tensor, "n patch 2"]) -> Float[Tensor, "n patch"]:
        """Bilinear brightness at pixel positions, each row in a view of its own; beyond an image that of its border."""
        size = self.sizes[view][:, None]
        position = torch.minimum((pixels - 0.5).clamp_min(0), (size - 1).to(pixels))
        corner = torch.minimum(position.detach().floor().long(), (size - 2).clamp_min(0))
        x, y = (position - corner).unbind(-1)
        width = size[..., 0]
        first = self.offsets[view][:, None] + corner[..., 1] * width + corner[..., 0]
        upper = (1 - x) * self.brightness[first] + x * self.brightness[first + 1]
        lower = (1 - x) * self.brightness[first + width] + x * self.brightness[first + width + 1]
        return (1 - y) * upper + y * lower


def correlation(first: Float[Tensor, "n patch"], second: Float[Tensor, "n patch"]) -> Float[Tensor, "n"]:
    """Normalised cross-correlation of patches: 1 where they are the same up to brightness and contrast."""
    first = first - first.mean(-1, keepdim=True)
    second = second - second.mean(-1, keepdim=True)
    variances = first.square().mean(-1) * second.square().mean(-1)
    return (first * second).mean(-1) / (variances + LEAST_VARIANCE**2).sqrt()
