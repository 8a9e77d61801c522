"""Images as pyramids of square blocks of pixels, each of which a cone around its middle ray stands for."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from distrace.camera import Camera
from distrace.rays import Rays, meet_sphere
from distrace.tracing.batch import Batch

BRANCH = 3  # blocks split into 3 × 3: the middle part keeps the ray of the whole


class Images:
    """One image or a batch of them as blocks of pixels, in the unit sphere.

    Rays start where the sphere comes nearest to their camera, so that a far camera costs no precision.
    """

    def __init__(self, camera: Camera, radius: float) -> None:
        intrinsics = camera.intrinsics.reshape(-1, 3, 3)
        pose = camera.T_world_camera.reshape(-1, 4, 4)
        inverse = torch.linalg.inv(intrinsics)
        self.height, self.width, self.views = camera.height, camera.width, len(pose)
        self.to_world = pose[:, :3, :3] @ inverse
        self.eye = pose[:, :3, 3] / radius
        self.shift = (self.eye.norm(dim=1) - 1).clamp_min(0)
        self.angle = inverse[:, :2, :2].norm(dim=1).amax(1)  # between the rays of neighbouring pixels, at most
        self.footprint = torch.stack([self.angle * self.shift, self.angle], dim=1)

    def level_of(self, width: float) -> int:
        """How often the image can be divided by 3 so that blocks, in the middle of the sphere, stay within a width."""
        pixel = float((self.angle * (self.shift + 1)).max())
        level = 0
        while reach(BRANCH ** (level + 1)) * pixel < width and BRANCH**level < max(self.height, self.width):
            level += 1
        return level

    def blocks(self, stride: int) -> Batch:
        """All blocks of `stride` pixels a side."""
        counts = (self.views, -(-self.height // stride), -(-self.width // stride))
        index = [torch.arange(count, device=self.eye.device) for count in counts]
        view, row, column = torch.cartesian_prod(*index).unbind(1)
        return self._batch(view, row, column, stride)

    def beside(self) -> Float[Tensor, "pixels"]:
        """How far the ray of each pixel goes to pass the middle of the sphere; infinite where it misses the sphere."""
        pixels = self.blocks(1)
        return beside_middle(Rays(pixels.origins, pixels.directions))

    def split(self, batch: Batch, stride: int) -> tuple[Batch, Int[Tensor, "m"]]:
        """The nine parts of each block, where they show something of the image, and the block of each.

        `stride` is that of the parts, in pixels.
        """
        parts = torch.arange(BRANCH, device=self.eye.device)
        row = (batch.row[:, None, None] * BRANCH + parts[:, None]).expand(-1, BRANCH, BRANCH).reshape(-1)
        column = (batch.column[:, None, None] * BRANCH + parts).expand(-1, BRANCH, BRANCH).reshape(-1)
        inside = ((row * stride < self.height) & (column * stride < self.width)).nonzero()[:, 0]
        parent = inside // BRANCH**2
        new = self._batch(batch.view[parent], row[inside], column[inside], stride)
        return replace(new, t=batch.t[parent], far=batch.far[parent]), parent

    def _batch(self, view: Tensor, row: Tensor, column: Tensor, stride: int) -> Batch:
        """Rays through the middles of blocks."""
        like = self.eye
        pixels = torch.stack([column, row, torch.ones_like(row)], dim=1).to(like.dtype)
        middles = pixels * like.new_tensor([stride, stride, 1.0]) + like.new_tensor([stride / 2, stride / 2, 0.0])
        if self.views == 1:
            directions = normalize(middles @ self.to_world[0].T, dim=1)
        else:
            directions = normalize((self.to_world[view] @ middles[:, :, None])[:, :, 0], dim=1)
        origins = torch.addcmul(self.eye[view], self.shift[view][:, None], directions)
        nothing = torch.zeros_like(origins[:, 0])
        return Batch(view, row, column, origins, directions, self.footprint[view], nothing, nothing)


def reach(stride: int) -> float:
    """From the middle of a block to the middle of its farthest pixel, in pixels."""
    return (stride - 1) / 2**0.5


def beside_middle(rays: Rays) -> Float[Tensor, "*batch"]:
    """How far each ray goes to pass the middle of the unit sphere; infinite where it misses the sphere."""
    bounds = meet_sphere(rays)
    nearest = -(rays.origins * rays.directions).sum(-1)
    return torch.where(bounds.meets, nearest.clamp(bounds.near, bounds.far), torch.inf)
