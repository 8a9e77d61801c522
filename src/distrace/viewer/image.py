"""A picture in bands of rows, so that tracing can stop between them; and the layers that are drawn from it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from distrace import shading
from distrace.render import Buffers
from distrace.shading import Picture
from distrace.tracing.sphere_tracing import Outcome

BAND = 1 << 15  # pixels
SHADED = "shaded"
ERRORS = (-8.0, -3.0)  # powers of ten of a radius, from the darkest to the brightest colour
Light = Float[np.ndarray, "3"] | None
"""The direction to the light; None: over the camera's left shoulder."""


@dataclass(frozen=True)
class Image:
    """Traced bands, from the top."""

    bands: Sequence[Buffers]

    def array(self, part: Callable[[Buffers], torch.Tensor]) -> np.ndarray:
        """Returns a part of every band as one array [height, width, …]."""
        return torch.cat([part(band) for band in self.bands]).detach().cpu().numpy()

    @property
    def depth(self) -> Float[np.ndarray, "height width"]:
        return self.array(lambda band: band.depth)

    @property
    def mask(self) -> Bool[np.ndarray, "height width"]:
        return self.array(lambda band: band.mask)

    @property
    def doubtful(self) -> int:
        """Rays that ended without an answer, or start inside the solid."""
        outcomes = self.array(lambda band: band.trace.outcome)
        return int(np.isin(outcomes, [int(Outcome.EXHAUSTED), int(Outcome.INSIDE)]).sum())

    @property
    def total_evaluations(self) -> int:
        return sum(band.trace.total_evaluations for band in self.bands)


def _shaded(image: Image, light: Light) -> tuple[Picture, str]:
    normal = image.array(lambda band: band.normal)
    directions = image.array(lambda band: band.rays.directions)
    return shading.shaded_picture(normal, image.mask, directions, light), ""


def _depth(image: Image, light: Light) -> tuple[Picture, str]:
    near, far = shading.depth_range(image.depth)
    return shading.depth_picture(image.depth), f"yellow {near:.3f} – violet {far:.3f} radii"


def _normal(image: Image, light: Light) -> tuple[Picture, str]:
    picture = shading.normal_picture(image.array(lambda band: band.normal), image.mask)
    return picture, "red, green, blue: x, y, z of the normal"


def _evaluations(image: Image, light: Light) -> tuple[Picture, str]:
    evaluations = image.array(lambda band: band.trace.evaluations)
    most = max(int(evaluations.max()), 1)
    everywhere = np.ones_like(evaluations, dtype=bool)
    return shading.heat_picture(evaluations / most, everywhere), f"violet 0 – yellow {most} evaluations of a ray"


def _error(image: Image, light: Light) -> tuple[Picture, str]:
    low, high = ERRORS
    share = (np.log10(np.maximum(image.array(_residual), 10**low)) - low) / (high - low)
    return shading.heat_picture(share, image.mask), f"violet |f| ≤ 1e{low:.0f} – yellow 1e{high:.0f} radii"


def _residual(band: Buffers) -> torch.Tensor:
    """Returns |f| at the points that were found; 0 where nothing was hit."""
    return torch.zeros_like(band.depth).masked_scatter(band.mask, band.field_at(band.mask)(band.points).abs())


LAYERS: dict[str, Callable[[Image, Light], tuple[Picture, str]]] = {
    SHADED: _shaded,
    "depth": _depth,
    "normal": _normal,
    "evaluations": _evaluations,
    "error": _error,
}
"""The pictures of an image, and what their colours mean. `error` is |f| at the surface that was found."""
