"""Small patches of photographs, compared between views through the surface.

A texture that a network learns is blurred for as long as the surface is off by more than a pixel, and then tells
little; patches of two photographs need no texture (Darmon et al., *NeuralWarp*, CVPR 2022; Fu et al., *Geo-NeuS*,
NeurIPS 2022). By their normalised cross-correlation another light does not count. Patches on the tangent plane, as
there, would make what is round smaller: the plane lies outside. So each of their pixels goes on to the surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF
from distrace.photos.stereo_pairs import partners

ACROSS = 5  # pixels of a patch
PARTNERS, BEST = 4, 2  # views that each is compared with, and of these those that count: the others may be hidden
FACING = 0.5  # the least cosine between a normal and the direction to an eye: flatter patches would make it smaller
EVEN = 1e-4  # variance of brightness below which a patch says nothing


@dataclass(frozen=True)
class Matching:
    """Photographs of any sizes, one after the other in one row of pixels, and which of them to compare."""

    brightness: Float[Tensor, "pixels"]
    begins: Int[Tensor, "views"]  # of each photograph in that row
    sizes: Int[Tensor, "views 2"]  # width and height
    intrinsics: Float[Tensor, "views 3 3"]
    T_camera_world: Float[Tensor, "views 4 4"]
    partners: Int[Tensor, "views count"]  # −1 where there are fewer

    @staticmethod
    def of(photographs: Sequence[Photograph], device: torch.device) -> "Matching":
        cameras = [each.camera for each in photographs]
        sizes = torch.tensor([[camera.width, camera.height] for camera in cameras])
        begins = torch.cat([torch.zeros(1, dtype=torch.long), sizes.prod(1).cumsum(0)[:-1]])
        parts = (
            torch.cat([each.image.mean(-1).reshape(-1) for each in photographs]),
            begins,
            sizes,
            torch.stack([camera.intrinsics for camera in cameras]),
            torch.linalg.inv(torch.stack([camera.T_world_camera for camera in cameras])),
            partners(cameras, PARTNERS),
        )
        return Matching(*(part.to(device) for part in parts))

    def moved(self, motions: Float[Tensor, "views 4 4"]) -> "Matching":
        """The same with each view's camera moved; differentiable in the motions."""
        return replace(self, T_camera_world=self.T_camera_world @ torch.linalg.inv(motions))

    def term(
        self,
        sdf: SDF,
        view: Int[Tensor, "n"],
        pixels: Float[Tensor, "n 2"],
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
    ) -> Float[Tensor, ""]:
        """The mean of 1 − correlation, of each point's patch in the view that sees it and those in its best partners.

        Differentiable in points and normals; 0 where no patch can be compared.
        """
        row, column = (self.partners[view] >= 0).nonzero().T
        other = self.partners[view][row, column]
        around, here = self._patches(sdf, view, pixels, points, normals)
        there, depth = self._projected(other[:, None], around[row])
        usable = self._faces(other, points[row], normals[row]) & self._faces(view, points, normals)[row]
        usable &= ((there > 0) & (there < self.sizes[other][:, None])).all(-1).all(-1) & (depth > 0).all(-1)
        lacking = torch.full(self.partners[view].shape, torch.inf).to(points)
        found = 1 - correlation(here[row], self._read(other[:, None], there))
        lacking = lacking.index_put((row[usable], column[usable]), found[usable])
        best = lacking.topk(min(BEST, lacking.shape[1]), dim=1, largest=False).values
        counted = best.isfinite()
        return torch.where(counted, best, 0.0).sum() / counted.sum().clamp_min(1)

    def _patches(
        self, sdf: SDF, view: Int[Tensor, "n"], pixels: Float[Tensor, "n 2"], points: Tensor, normals: Tensor
    ) -> tuple[Float[Tensor, "n patch 3"], Float[Tensor, "n patch"]]:
        """Where the rays of the pixels around meet the surface, and how bright they are.

        That is one step of Newton's from the tangent plane, with which the places move; no longer than it is wide.
        """
        steps = torch.arange(ACROSS, device=pixels.device) - ACROSS // 2
        around = pixels[:, None] + torch.cartesian_prod(steps, steps)
        rotation, shift = self.T_camera_world[view, :3, :3], self.T_camera_world[view, :3, 3]
        eyes = -(rotation.mT @ shift[..., None])[..., 0]
        ones = torch.ones_like(around[..., :1])
        turned = torch.linalg.inv(self.intrinsics[view]).mT @ rotation
        directions = torch.cat([around, ones], dim=-1) @ turned
        height = ((points - eyes) * normals).sum(-1, keepdim=True)
        slope = (directions * normals[:, None]).sum(-1)
        slope = torch.where(slope.abs() < 1e-6, -1e-6, slope)
        on_plane = eyes[:, None] + (height / slope)[..., None] * directions
        with torch.no_grad():
            width = (on_plane - points[:, None]).norm(dim=-1)
            off = torch.minimum(sdf(on_plane), width).maximum(-width)
        return on_plane - (off / slope.detach())[..., None] * directions.detach(), self._read(view[:, None], around)

    def _projected(
        self, view: Int[Tensor, "n 1"], points: Float[Tensor, "n patch 3"]
    ) -> tuple[Float[Tensor, "n patch 2"], Float[Tensor, "n patch"]]:
        pose = self.T_camera_world[view[:, 0]]
        seen = (points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]) @ self.intrinsics[view[:, 0]].mT
        depth = seen[..., 2]
        return seen[..., :2] / torch.where(depth > 1e-6, depth, 1e-6)[..., None], depth

    def _faces(self, view: Int[Tensor, "n"], points: Tensor, normals: Tensor) -> Bool[Tensor, "n"]:
        pose = self.T_camera_world[view]
        eyes = -(pose[:, :3, :3].mT @ pose[:, :3, 3:])[..., 0]
        return torch.nn.functional.cosine_similarity(eyes - points, normals, dim=-1) > FACING

    def _read(self, view: Int[Tensor, "n 1"], pixels: Float[Tensor, "n patch 2"]) -> Float[Tensor, "n patch"]:
        """Brightness between the pixels' middles, linearly; beyond an image that of its border."""
        size = self.sizes[view]
        place = torch.minimum((pixels - 0.5).clamp_min(0), (size - 1).to(pixels))
        corner = torch.minimum(place.detach().floor().long(), (size - 2).clamp_min(0))
        x, y = (place - corner).unbind(-1)
        width = size[..., 0]
        first = self.begins[view] + corner[..., 1] * width + corner[..., 0]
        upper = (1 - x) * self.brightness[first] + x * self.brightness[first + 1]
        lower = (1 - x) * self.brightness[first + width] + x * self.brightness[first + width + 1]
        return (1 - y) * upper + y * lower


def correlation(first: Float[Tensor, "n patch"], second: Float[Tensor, "n patch"]) -> Float[Tensor, "n"]:
    """Normalised cross-correlation of patches: 1 where they are the same up to brightness and contrast."""
    first, second = first - first.mean(-1, keepdim=True), second - second.mean(-1, keepdim=True)
    spread = first.square().mean(-1) * second.square().mean(-1)
    return (first * second).mean(-1) / (spread + EVEN**2).sqrt()
