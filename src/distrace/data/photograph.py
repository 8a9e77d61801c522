"""One photograph: its camera, its colours, and the object's mask."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera

MIN_COVERED = 1e-3  # pixels: what a last row or column covers at least, where the factor is not exact


@dataclass(frozen=True)
class Source:
    """What a photograph was read from: its files, and the camera in the folder's world, in double."""

    image: Path
    camera: Camera
    mask: Path | None = None


@dataclass(frozen=True)
class Photograph:
    """Colours from 0 to 1 as stored (sRGB), in the pixels of the camera; the mask, if known, says what is object."""

    name: str  # of the image's file, without suffix
    camera: Camera
    image: Float[Tensor, "height width 3"]
    mask: Bool[Tensor, "height width"] | None = None
    source: Source | None = None

    def to(self, device: torch.device | str) -> "Photograph":
        mask = None if self.mask is None else self.mask.to(device)
        return replace(self, camera=self.camera.to(device), image=self.image.to(device), mask=mask)

    @property
    def known_mask(self) -> Bool[Tensor, "height width"]:
        """The mask; raises `ValueError` where there is none."""
        if self.mask is None:
            raise ValueError(f"{self.name} has no mask; one is needed that says what is object")
        return self.mask

    def at_most(self, size: int) -> "Photograph":
        """Coarser where its longer side has more pixels than that."""
        return self.resized(min(1.0, size / max(self.camera.height, self.camera.width)))

    def resized(self, factor: float) -> "Photograph":
        """The same photograph with coarser pixels, each the mean of the area that it covers.

        A mask holds the pixels of which it covered more than half. Raises `ValueError` for a factor not in (0, 1].
        """
        if not 0 < factor <= 1:
            raise ValueError(
                f"photographs were to be resized by {factor}; factors above 0 and up to 1 make them coarser"
            )
        camera = self.camera.resized(factor)
        image = averaged(self.image, factor).float()
        mask = None if self.mask is None else averaged(self.mask[..., None], factor)[..., 0] > 0.5
        return replace(self, camera=camera, image=image, mask=mask)


def averaged(image: Tensor, factor: float) -> Float[Tensor, "height_ width_ channels"]:
    """Means over the areas that coarser pixels cover; of those beyond the edge, over the part within."""
    across = _averaged(image.double(), factor)
    return _averaged(across.transpose(0, 1), factor).transpose(0, 1)


def _averaged(image: Float[Tensor, "rows columns channels"], factor: float) -> Float[Tensor, "rows_ columns channels"]:
    """Along the rows, by differences of the integral: exact for any factor."""
    length = image.shape[0]
    edges = torch.arange(math.ceil(length * factor) + 1, dtype=torch.float64, device=image.device) / factor
    start = edges[:-1].clamp_max(length - MIN_COVERED)
    end = edges[1:].clamp_max(length)
    integral = torch.cat([torch.zeros_like(image[:1]), image.cumsum(0)])
    return (_between(integral, end) - _between(integral, start)) / (end - start)[:, None, None]


def _between(integral: Tensor, at: Float[Tensor, "n"]) -> Tensor:
    lower = at.long().clamp_max(len(integral) - 2)
    return torch.lerp(integral[lower], integral[lower + 1], (at - lower)[:, None, None])
