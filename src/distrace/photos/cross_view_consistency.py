"""Pixels that show what most other views allow: a neighbour of the object's colour is inconsistent between views.

After Campbell et al., *Automatic 3D object segmentation in multiple views using volumetric graph-cuts* (BMVC 2007);
here the views vote in place of a graph cut.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from distrace.camera import Camera
from distrace.photos.visual_hull import grid_centres, is_solid

CELLS = 48  # along each axis of the cube around the unit sphere
WRONG_VIEWS = 0.15  # share of the views of a cell that may take it for the background: parts may look like that


@dataclass(frozen=True)
class CrossViewConsistency:
    """The unit sphere's cells as each view sees them: projected once, and used for every shape."""

    views: Sequence["_ProjectedCells"]
    visible: Float[Tensor, "cells"]  # the number of views that contain each cell

    @staticmethod
    def of(cameras: Sequence[Camera]) -> "CrossViewConsistency":
        """Projects the cells into each camera's image."""
        centres = grid_centres(CELLS, cameras[0].intrinsics.device)
        views = [_ProjectedCells.of(camera, centres[centres.norm(dim=-1) < 1]) for camera in cameras]
        return CrossViewConsistency(views, torch.stack([view.inside for view in views]).sum(0).float())

    def silhouettes(self, masks: Sequence[Bool[Tensor, "_ _"]]) -> list[Bool[Tensor, "_ _"]]:
        """The masks, one a view, reduced to the silhouettes of the cells that most of them contain."""
        left_out = torch.zeros_like(self.visible)
        for view, mask in zip(self.views, masks, strict=True):
            left_out += view.inside & ~mask.reshape(-1)[view.pixel]
        solid = is_solid(self.visible, left_out, len(self.views), WRONG_VIEWS)
        return [view.silhouette(solid) for view in self.views]


@dataclass(frozen=True)
class _ProjectedCells:
    """The pixel and the depth of each cell in a camera's image."""

    camera: Camera
    inside: Bool[Tensor, "cells"]
    pixel: Int[Tensor, "cells"]  # flat index; 0 for cells outside the image
    depth: Float[Tensor, "cells"]

    @staticmethod
    def of(camera: Camera, centres: Float[Tensor, "cells 3"]) -> "_ProjectedCells":
        pixels, depth = camera.project(centres)
        inside = camera.shows(pixels, depth)
        column, row = pixels.masked_fill(~inside[:, None], 0.0).long().T
        return _ProjectedCells(camera, inside, row * camera.width + column, depth)

    def silhouette(self, solid: Bool[Tensor, "cells"]) -> Bool[Tensor, "height width"]:
        """The pixels that solid cells cover, widened by half of the nearest cell's diagonal."""
        camera = self.camera
        within = solid & self.inside
        covered = self.depth.new_zeros(camera.height, camera.width)
        covered.view(-1)[self.pixel[within]] = 1.0
        if not within.any():
            return covered.bool()
        radius = math.sqrt(3) / CELLS * float(camera.intrinsics[0, 0] / self.depth[within].min())
        reach = min(math.ceil(radius), max(camera.height, camera.width))
        return _dilate_rows(_dilate_rows(covered, reach).T, reach).T > 0


def _dilate_rows(covered: Float[Tensor, "rows columns"], reach: int) -> Float[Tensor, "rows columns"]:
    """Dilates by `reach` columns to both sides; rows and then columns take less time than a large square."""
    return max_pool1d(pad(covered, (reach, reach)), 2 * reach + 1, 1)
