"""Depths from photographs alone, where they are sure: planes are swept through the unit sphere, and images compared.

Collins, *A space-sweep approach to true multi-image matching*, CVPR 1996; by windows parallel to the image and their
normalised cross-correlation, of which the best partners count (Kang, Szeliski and Chai, CVPR 2001, section 3.1).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.photos.stereo_pairs import about, partners, windowed

SIZE = 160  # pixels along the longer side, of views that are compared
PLANES = 96  # about one for each pixel by which neighbours show them apart
NEAREST = 0.1  # radii: of the planes, where an eye is within the sphere, or looks away
PARTNERS, BEST = 4, 2  # views that each is compared with, and of these those that count: the others may be hidden
WINDOW = 7  # pixels
EVEN = 4e-4  # variance of brightness below which a window says nothing
ALIKE = 0.7  # correlation of a sure match, …
ALONE, BESIDE = 0.1, 4  # … and by how much it beats all that are farther than so many planes away
OFF = 0.03  # radii: how far depths that are sure may be wrong


@dataclass(frozen=True)
class Depths:
    """What one view's neighbours tell of its depths; only those that are sure say anything."""

    camera: Camera
    depth: Float[Tensor, "height width"]
    sure: Bool[Tensor, "height width"]

    def votes(self, points: Float[Tensor, "n 3"]) -> tuple[Bool[Tensor, "n"], Bool[Tensor, "n"]]:
        """Which points the view sees through, and which lie where it sees something."""
        pixels, depths = self.camera.project(points)
        through, there = torch.zeros(2, len(points), dtype=torch.bool)
        shown = self.camera.shows(pixels, depths)
        column, row = pixels[shown].long().unbind(-1)
        before = self.depth[row, column] - depths[shown]
        through[shown] = self.sure[row, column] & (before > OFF)
        there[shown] = self.sure[row, column] & (before.abs() <= OFF)
        return through, there


@torch.no_grad()
def swept(photographs: Sequence[Photograph]) -> list[Depths]:
    """Of each photograph that another can be compared with, in coarse pixels. Raises `ValueError` without a mask."""
    views = [each.at_most(SIZE) for each in photographs]
    chosen = partners([each.camera for each in views], PARTNERS).tolist()
    beside = [[views[other] for other in row if other >= 0] for row in chosen]
    return [_depths(view, others) for view, others in zip(views, beside, strict=True) if others]


def _depths(view: Photograph, others: Sequence[Photograph]) -> Depths:
    """The planes, parallel to the image, on which it is most like its partners."""
    camera = view.camera
    centre = camera.project(torch.zeros(1, 3))[1].item()
    planes = 1 / torch.linspace(1 / max(centre - 1, NEAREST), 1 / max(centre + 1, 2 * NEAREST), PLANES)
    here, rays, stretch = _Image.of(view.image.mean(-1)), camera.rays(), 1 / camera.cosines()
    alike = torch.stack([_alike(here, others, rays.at(depth * stretch)) for depth in planes])
    best, plane = alike.max(0)
    beside = (torch.arange(PLANES)[:, None, None] - plane).abs() <= BESIDE
    alone = best - alike.masked_fill(beside, -1).amax(0) > ALONE
    return Depths(camera, planes[plane], view.known_mask & (here.variance > EVEN) & (best > ALIKE) & alone)


@dataclass(frozen=True)
class _Image:
    """Brightness, with its mean and its variance over the window about each pixel."""

    brightness: Float[Tensor, "height width"]
    mean: Float[Tensor, "height width"]
    variance: Float[Tensor, "height width"]

    @staticmethod
    def of(brightness: Float[Tensor, "height width"]) -> "_Image":
        mean, variance = about(brightness[None], WINDOW)
        return _Image(brightness, mean[0], variance[0])


def _alike(
    here: _Image, others: Sequence[Photograph], points: Float[Tensor, "height width 3"]
) -> Float[Tensor, "height width"]:
    """The correlation with the best partners, if pixels show these points."""
    found = torch.stack([_correlation(here, other, points) for other in others])
    return found.topk(min(BEST, len(found)), dim=0).values.mean(0)


def _correlation(
    here: _Image, other: Photograph, points: Float[Tensor, "height width 3"]
) -> Float[Tensor, "height width"]:
    """Of windows about each pixel and about where the other view shows its point; −1 where there is nothing to see."""
    pixels, depths = other.camera.project(points)
    size = pixels.new_tensor([other.camera.width, other.camera.height])
    grid = (2 * pixels / size - 1)[None]
    brightness = other.image.mean(-1)[None, None]
    seen = grid_sample(brightness, grid, padding_mode="border", align_corners=False)[0, 0]
    there = _Image.of(seen)
    together = windowed((here.brightness * seen)[None], WINDOW)[0] - here.mean * there.mean
    found = together / (here.variance * there.variance).sqrt().clamp_min(EVEN / 10)
    return torch.where(other.camera.shows(pixels, depths) & (there.variance > EVEN), found, -1.0)
