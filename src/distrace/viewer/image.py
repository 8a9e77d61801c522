"""A picture in bands of rows, so that tracing can stop between them; and the layers that are drawn from it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

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
    """Traced bands, from the top; each array is made when a layer asks for it."""

    bands: Sequence[Buffers]

    @cached_property
    def depth(self) -> Float[np.ndarray, "height width"]:
        return _joined([band.depth for band in self.bands])

    @cached_property
    def mask(self) -> Bool[np.ndarray, "height width"]:
        return _joined([band.mask for band in self.bands])

    @cached_property
    def normal(self) -> Float[np.ndarray, "height width 3"]:
        return _joined([band.normal for band in self.bands])

    @cached_property
    def directions(self) -> Float[np.ndarray, "height width 3"]:
        return _joined([band.rays.directions for band in self.bands])

    @cached_property
    def evaluations(self) -> Int[np.ndarray, "height width"]:
        return _joined([band.trace.evaluations for band in self.bands])

    @cached_property
    def error(self) -> Float[np.ndarray, "height width"]:
        """|f| at the points that were found; 0 where nothing was hit."""
        values = [torch.zeros_like(band.depth).masked_scatter(band.mask, _values(band)) for band in self.bands]
        return _joined(values)

    @property
    def doubtful(self) -> int:
        """Rays that ended without an answer, or start inside the solid."""
        outcomes = _joined([band.trace.outcome for band in self.bands])
        return int(np.isin(outcomes, [int(Outcome.EXHAUSTED), int(Outcome.INSIDE)]).sum())

    @property
    def total_evaluations(self) -> int:
        return sum(band.trace.total_evaluations for band in self.bands)


def _joined(parts: Sequence[torch.Tensor]) -> np.ndarray:
    return torch.cat(list(parts)).detach().cpu().numpy()


def _values(band: Buffers) -> torch.Tensor:
    return band.field_at(band.mask)(band.points).abs()


def _shaded(image: Image, light: Light) -> tuple[Picture, str]:
    return shading.shaded_picture(image.normal, image.mask, image.directions, light), ""


def _depth(image: Image, light: Light) -> tuple[Picture, str]:
    near, far = shading.depth_range(image.depth)
    return shading.depth_picture(image.depth), f"yellow {near:.3f} – violet {far:.3f} radii"


def _normal(image: Image, light: Light) -> tuple[Picture, str]:
    return shading.normal_picture(image.normal, image.mask), "red, green, blue: x, y, z of the normal"


def _evaluations(image: Image, light: Light) -> tuple[Picture, str]:
    most = max(int(image.evaluations.max()), 1)
    everywhere = np.ones_like(image.mask)
    return shading.heat_picture(image.evaluations / most, everywhere), f"violet 0 – yellow {most} evaluations of a ray"


def _error(image: Image, light: Light) -> tuple[Picture, str]:
    low, high = ERRORS
    share = (np.log10(np.maximum(image.error, 10**low)) - low) / (high - low)
    return shading.heat_picture(share, image.mask), f"violet |f| ≤ 1e{low:.0f} – yellow 1e{high:.0f} radii"


LAYERS: dict[str, Callable[[Image, Light], tuple[Picture, str]]] = {
    SHADED: _shaded,
    "depth": _depth,
    "normal": _normal,
    "evaluations": _evaluations,
    "error": _error,
}
"""The pictures of an image, and what their colours mean. `error` is |f| at the surface that was found."""
