"""Image values with gradients at any position, statistics of windows, and the choice of neighbour views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, normalize, pad

from distrace.camera import Camera

BEST_DEGREES = 20.0  # between two views of a point: a baseline for depth, and alike enough to match …
WIDEST_DEGREES = 50.0  # … up to this
LIGHT_WINDOW = 9  # pixels over which the light is taken to be constant
LEAST_CONTRAST = 0.02  # standard deviation of colour that counts as noise


@dataclass(frozen=True)
class GradientImage:
    """Channels of an image, each with its gradient along x and y, per pixel."""

    camera: Camera
    channels: Float[Tensor, "values_and_slopes height width"]

    @staticmethod
    def of(image: Float[Tensor, "height width channels"], camera: Camera) -> "GradientImage":
        """Takes central differences as gradients, with the image's border repeated."""
        values = image.permute(2, 0, 1)
        wide = pad(values[None], (1, 1, 1, 1), mode="replicate")[0]
        along_x = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2
        along_y = (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
        return GradientImage(camera, torch.cat([values, along_x, along_y]))

    def at(self, pixels: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n channels"], Float[Tensor, "n channels 2"]]:
        """Bilinear values and gradients at pixel positions; beyond the image those of its border."""
        values, along_x, along_y = sample_image(self.channels, pixels[None])[:, 0].T.chunk(3, dim=1)
        return values, torch.stack([along_x, along_y], dim=-1)

    def project(self, points_world: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"]]:
        """Pixel positions of points, and their Jacobian with respect to the points."""
        rotation = self.camera.T_world_camera[:3, :3]
        pixels, depth = self.camera.project(points_world)
        by_depth = torch.cat([pixels.new_zeros(len(pixels), 2, 2), pixels[..., None]], dim=-1)
        return pixels, (self.camera.intrinsics[:2][None] - by_depth) @ rotation.T / depth[:, None, None]


def sample_image(
    channels: Float[Tensor, "channels height width"], pixels: Float[Tensor, "rows columns 2"]
) -> Float[Tensor, "channels rows columns"]:
    """Bilinear values at pixel positions; beyond the image those of its border."""
    size = pixels.new_tensor([channels.shape[2], channels.shape[1]])
    grid = (2 * pixels / size - 1)[None]
    return grid_sample(channels[None], grid, padding_mode="border", align_corners=False)[0]


def normalise_light(image: Float[Tensor, "height width channels"]) -> Float[Tensor, "height width channels"]:
    """The image without its local mean and contrast, so that it hardly depends on the light.

    Differences between such images are those of normalised cross-correlation.
    """
    values = image.permute(2, 0, 1)
    mean, variance = window_moments(values, LIGHT_WINDOW)
    return (0.2 * (values - mean) / (variance.sqrt() + LEAST_CONTRAST)).permute(1, 2, 0)


def window_moments(images: Float[Tensor, "n height width"], window: int) -> tuple[Tensor, Tensor]:
    """Mean and variance over the window about each pixel, as far as it lies within the image."""
    mean = window_mean(images, window)
    return mean, (window_mean(images.square(), window) - mean.square()).clamp_min(0)


def window_mean(images: Float[Tensor, "n height width"], window: int) -> Float[Tensor, "n height width"]:
    """The mean over the window about each pixel; `window` is odd, in pixels."""
    return avg_pool2d(images[None], window, 1, window // 2, count_include_pad=False)[0]


def neighbour_views(cameras: Sequence[Camera], count: int) -> Int[Tensor, "views count"]:
    """The views to compare each view with, best first; −1 where there are fewer than `count`.

    The best are about `BEST_DEGREES` apart as seen from the origin. None is beyond `WIDEST_DEGREES`, except that each
    view has one neighbour at least.
    """
    eyes = normalize(torch.stack([camera.T_world_camera[:3, 3] for camera in cameras]), dim=-1)
    degrees = (eyes @ eyes.T).clamp(-1, 1).acos() * (180 / math.pi)
    cost = (degrees / BEST_DEGREES).clamp_min(1e-3).log().abs().fill_diagonal_(torch.inf)
    ranked = cost.argsort(dim=1)[:, : min(count, len(cameras) - 1)]
    too_far = degrees.gather(1, ranked) > WIDEST_DEGREES
    too_far[:, :1] = False
    return ranked.masked_fill(too_far, -1)
