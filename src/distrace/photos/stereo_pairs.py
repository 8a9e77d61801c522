"""Photographs as a photometric loss reads them: colours and their slopes at any place, and which views to compare."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, normalize, pad

from distrace.camera import Camera

BEST, WIDEST = 20.0, 50.0  # degrees between two views of a point: enough to tell its depth, and alike enough to match
WINDOW = 9  # pixels, across which light is taken to be even
CONTRAST = 0.02  # standard deviation of colour below which nothing is to be told from noise


@dataclass(frozen=True)
class Colours:
    """Channels of an image, each with its slopes to the right and down, per pixel."""

    camera: Camera
    channels: Float[Tensor, "values_and_slopes height width"]

    @staticmethod
    def of(image: Float[Tensor, "height width channels"], camera: Camera) -> "Colours":
        values = image.permute(2, 0, 1)
        wide = pad(values[None], (1, 1, 1, 1), mode="replicate")[0]
        right = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2
        down = (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
        return Colours(camera, torch.cat([values, right, down]))

    def at(self, pixels: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n channels"], Float[Tensor, "n channels 2"]]:
        """Values and slopes between the pixels' centres; beyond the image those of its border."""
        size = pixels.new_tensor([self.camera.width, self.camera.height])
        grid = (2 * pixels / size - 1)[None, None]
        found = grid_sample(self.channels[None], grid, padding_mode="border", align_corners=False)[0, :, 0].T
        values, right, down = found.chunk(3, dim=1)
        return values, torch.stack([right, down], dim=-1)

    def projected(self, points_world: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"]]:
        """The pixels that show points, and how they move with them."""
        rotation, focal = self.camera.T_world_camera[:3, :3], self.camera.intrinsics[:2]
        pixels, depth = self.camera.project(points_world)
        moved = (focal[None] - torch.cat([pixels.new_zeros(len(pixels), 2, 2), pixels[..., None]], dim=-1)) @ rotation.T
        return pixels, moved / depth[:, None, None]


def without_light(image: Float[Tensor, "height width channels"]) -> Float[Tensor, "height width channels"]:
    """What is left of an image when its local mean and contrast are taken away: the same in another light.

    Differences of it are those of normalised cross-correlation.
    """
    values = image.permute(2, 0, 1)
    mean, variance = about(values, WINDOW)
    return (0.2 * (values - mean) / (variance.sqrt() + CONTRAST)).permute(1, 2, 0)


def about(images: Float[Tensor, "n height width"], window: int) -> tuple[Tensor, Tensor]:
    """Mean and variance over the window about each pixel, as far as it lies within the image."""
    mean = windowed(images, window)
    return mean, (windowed(images.square(), window) - mean.square()).clamp_min(0)


def windowed(images: Float[Tensor, "n height width"], window: int) -> Float[Tensor, "n height width"]:
    return avg_pool2d(images[None], window, 1, window // 2, count_include_pad=False)[0]


def partners(cameras: Sequence[Camera], count: int) -> Int[Tensor, "views count"]:
    """Of each view the others to compare it with, −1 where there are fewer: those apart by about `BEST` degrees, seen
    from the origin, and by `WIDEST` at most; one at least, if there is another.
    """
    eyes = normalize(torch.stack([camera.T_world_camera[:3, 3] for camera in cameras]), dim=-1)
    degrees = (eyes @ eyes.T).clamp(-1, 1).acos() * (180 / math.pi)
    cost = (degrees / BEST).clamp_min(1e-3).log().abs().fill_diagonal_(torch.inf)
    ranked = cost.argsort(dim=1)[:, : min(count, len(cameras) - 1)]
    too_far = degrees.gather(1, ranked) > WIDEST
    too_far[:, :1] = False
    return ranked.masked_fill(too_far, -1)
