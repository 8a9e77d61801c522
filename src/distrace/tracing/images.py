"""The rays of images in the unit sphere: those of all pixels, and the middle rays of square blocks of pixels."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from distrace.camera import Camera
from distrace.rays import Rays, meet_sphere

BRANCH = 3  # blocks split into 3 × 3: the middle part keeps the ray of the whole


@dataclass(frozen=True)
class Lines:
    """Rays that are traced together, in radii. They start at the sphere's nearest distance from their camera."""

    table: Float[Tensor, "n 8"]  # origin, direction, distance at the point nearest to the centre, 1 − (its radius)²
    view: Int[Tensor, "n"] | None  # the number of each ray's image, and of its shape; None for a single image

    @staticmethod
    def of(origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], view: Int[Tensor, "n"] | None) -> "Lines":
        middle = -(origins * directions).sum(1, keepdim=True)
        inside = 1 - torch.addcmul(origins, middle, directions).square().sum(1, keepdim=True)
        return Lines(torch.cat([origins, directions, middle, inside], dim=1), view)

    def __getitem__(self, index: Int[Tensor, "m"]) -> "Lines":
        view = None if self.view is None else self.view.index_select(0, index)
        return Lines(self.table.index_select(0, index), view)

    @cached_property
    def parts(self) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 2"]]:
        """Origins, directions, and the last two columns of the table."""
        origins, directions, rest = self.table.split([3, 3, 2], 1)
        return origins, directions, rest

    def at(self, t: Float[Tensor, "*k n"]) -> Float[Tensor, "*k n 3"]:
        return torch.addcmul(self.parts[0], t[..., None], self.parts[1])

    def in_sphere(self, radius: float = 1.0) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Returns the interval of each ray in a sphere of this radius; near ≥ far where it misses."""
        middle, inside = self.parts[2].unbind(1)
        half = (inside if radius == 1 else inside + (radius**2 - 1)).clamp_min(0).sqrt()
        return (middle - half).clamp_min(0), middle + half

    def of_view(self, values: Float[Tensor, "views"]) -> Float[Tensor, "#n"]:
        """Returns values of views for each ray."""
        return values if self.view is None else values.index_select(0, self.view)


@dataclass(frozen=True)
class Pixels:
    """All rays that may be traced, by number; the grids of images are padded to whole blocks."""

    lines: Lines
    start: Float[Tensor, "#n"]  # distances of the origins from the camera
    width: Float[Tensor, "views"]  # of a pixel at the origins …
    growth: Float[Tensor, "views"]  # … by how much per unit of distance …
    middle: Float[Tensor, "views"]  # … and in the middle of the sphere
    shape: tuple[int, int, int]  # views, rows, columns; with the padding
    size: tuple[int, ...]  # … and without it
    level: int = 0  # the largest blocks have BRANCH ** level pixels a side

    @staticmethod
    def of_camera(camera: Camera, rays: Rays, radius: float, largest: float) -> "Pixels":
        """Returns the pixels of an image or a batch; at the sphere's centre the cones of blocks stay within `largest`.

        Padding repeats the last rows and columns: no farther from the middle of their blocks than others.
        """
        pose = camera.T_world_camera.reshape(-1, 4, 4)
        inverse = torch.linalg.inv(camera.intrinsics.reshape(-1, 3, 3))
        eye = pose[:, :3, 3] / radius
        shift = (eye.norm(dim=1) - 1).clamp_min(0)
        growth = torch.linalg.matrix_norm(inverse[:, :2, :2], 2)
        width = growth * shift
        middle = width + growth
        level = 0
        pixel = float(middle.max())
        least = min(camera.height, camera.width)
        while reach(BRANCH ** (level + 1)) * pixel < largest and BRANCH ** (level + 1) <= least:
            level += 1
        views = len(eye)
        side = BRANCH**level
        rows, columns = (-(-size // side) * side for size in (camera.height, camera.width))
        directions = rays.directions.reshape(1, views, camera.height, camera.width, 3)
        directions = pad(directions, (0, 0, 0, columns - camera.width, 0, rows - camera.height), mode="replicate")[0]
        origins = torch.addcmul(eye.reshape(-1, 1, 1, 3), shift.reshape(-1, 1, 1, 1), directions)
        view = None if views == 1 else torch.arange(views, device=eye.device).repeat_interleave(rows * columns)
        lines = Lines.of(origins.reshape(-1, 3), directions.reshape(-1, 3), view)
        size = (*camera.intrinsics.shape[:-2], camera.height, camera.width)
        return Pixels(lines, lines.of_view(shift), width, growth, middle, (views, rows, columns), size, level)

    @staticmethod
    def of_rays(rays: Rays) -> "Pixels":
        """Returns rays that are no image, starting as they enter a sphere of twice the radius."""
        start = meet_sphere(rays, 2.0).near.nan_to_num(posinf=0.0)
        lines = Lines.of(rays.at(start), rays.directions, None)
        zero = start.new_zeros(1)
        return Pixels(lines, start, zero, zero, zero + torch.inf, (1, 1, len(start)), (len(start),))

    @cached_property
    def span(self) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """The interval of each ray in the sphere."""
        return self.lines.in_sphere()

    def blocks(self) -> Int[Tensor, "n"]:
        """Returns the middle rays of all of the largest blocks."""
        views, rows, columns = self.shape
        side = BRANCH**self.level
        number = torch.arange(views * rows * columns, device=self.width.device).reshape(views * rows, columns)
        return number[side // 2 :: side, side // 2 :: side].reshape(-1)

    def split(self, blocks: Int[Tensor, "n"], side: int) -> Int[Tensor, "m"]:
        """Returns the middle rays of the nine parts of each block, in its order; parts are `side` pixels wide."""
        offset = torch.arange(-side, side + 1, side, device=blocks.device)
        around = (offset[:, None] * self.shape[2] + offset).reshape(-1)
        return (blocks[:, None] + around).reshape(-1)

    def image(self, values: Float[Tensor, "k n"]) -> Float[Tensor, "k *size"]:
        """Returns values of rays as images, without the padding."""
        rows, columns = (1, *self.size)[-2:]
        images = values.reshape(len(values), *self.shape)[..., :rows, :columns]
        return images.reshape(len(values), *self.size)


def reach(side: int) -> float:
    """Returns the distance from the middle of a block to that of its farthest pixel, in pixels."""
    return (side - 1) / math.sqrt(2)
