"""Antialiased pictures: several rays a pixel, averaged in linear light."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch.nn.functional import max_pool2d

from distrace.camera import Camera
from distrace.coloured import coloured_picture, studio
from distrace.fields.base import SDF
from distrace.fields.colour import Albedo
from distrace.render import Buffers, Config, render, render_rays
from distrace.shading import WHITE, Colour, Picture, Rgba, key_light, mask_picture, mean_light, shaded_picture
from distrace.tracing.tracer import TracerConfig

BAND = 1 << 20  # rays rendered together: those of a whole large picture take too much memory
QUARTERS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))  # pixels from a pixel's centre


@dataclass(frozen=True)
class Style:
    """How a shape is drawn: `samples` × `samples` rays a pixel, a background, a direction to the light, and colours."""

    samples: int = 1
    background: Colour | None = WHITE  # None: transparent
    light: Float[np.ndarray, "3"] | None = None  # None: over the camera's left shoulder
    albedo: Albedo | None = None  # None: clay

    @torch.no_grad()
    def draw(
        self, sdf: SDF, buffers: Buffers, camera: Camera, config: Config = TracerConfig()
    ) -> tuple[Picture | Rgba, Picture]:
        """Returns the shaded picture and the picture of the mask, the latter on white.

        `buffers` is what the camera sees of the field; with one ray a pixel nothing else is rendered.
        """
        light = key_light(buffers.rays.directions) if self.light is None else self.light
        parts = [buffers] if self.samples == 1 else self._rendered(sdf, buffers, camera, config)
        shaded: list[np.ndarray] = []
        masks: list[np.ndarray] = []
        for part in parts:
            shaded.append(mean_light(self._painted(part, light), part.mask, self.samples, self.background))
            masks.append(mean_light(mask_picture(part.mask), part.mask, self.samples, WHITE))
        return np.concatenate(shaded), np.concatenate(masks)

    def _painted(self, buffers: Buffers, light: Float[np.ndarray, "3"]) -> Picture:
        if self.albedo is None:
            return clay_picture(buffers, light)
        return coloured_picture(buffers, self.albedo, studio(buffers, light))

    def _rendered(self, sdf: SDF, buffers: Buffers, camera: Camera, config: Config) -> Iterator[Buffers]:
        """Yields bands of the picture from the top, each with `samples` rays along both sides of a pixel."""
        for band in camera.bands(BAND // self.samples**2):
            yield render(sdf, band.resized(float(self.samples)), config=config, occupancy=buffers.occupancy)


def clay_picture(buffers: Buffers, light: Float[np.ndarray, "3"] | None = None) -> Picture:
    """Returns the shaded picture of what a camera sees, as `shaded_picture` does, with one ray a pixel."""
    return shaded_picture(buffers.normal, buffers.mask, buffers.rays.directions, light)


@torch.no_grad()
def smooth_outline(buffers: Buffers, camera: Camera) -> Picture:
    """Returns the shaded picture with four rays in each pixel at the outline, and one in all others.

    It costs less than an image of twice the size; edges within the outline stay as they are.
    """
    light = key_light(buffers.rays.directions)
    picture = clay_picture(buffers, light)
    inner = buffers.mask.float()[None]
    grown = max_pool2d(inner, 3, 1, 1)[0] > 0
    shrunk = -max_pool2d(-inner, 3, 1, 1)[0] > 0
    outline = grown & ~shrunk
    if not outline.any():
        return picture
    centres = camera.pixels().to(buffers.cosines)[outline]
    offsets = centres.new_tensor(QUARTERS)
    fine = render_rays(buffers.sdf, camera, (centres[:, None] + offsets).reshape(-1, 2), radius=buffers.radius)
    square = (2 * len(centres), 2)  # each pixel's rays, one pixel below the other
    colours = shaded_picture(
        fine.normal.reshape(*square, 3), fine.mask.reshape(square), fine.rays.directions.reshape(*square, 3), light
    )
    picture[outline.cpu().numpy()] = mean_light(colours, fine.mask.reshape(square), 2, WHITE)[:, 0]
    return picture
