"""What looks like the object in one view, and can be it by the others: a neighbour of its colour is there only once.

After Campbell et al., *Automatic 3D object segmentation in multiple views using volumetric graph-cuts* (BMVC 2007),
whose cut is a vote of the views here.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from distrace.camera import Camera
from distrace.photos.visual_hull import cells_about, let_by

CELLS = 48  # along each axis of the cube around the unit sphere
DISAGREE = 0.15  # of the views that see a place may take it for the background: parts look like that


@dataclass(frozen=True)
class Consensus:
    """Views of the unit sphere's cells: looked up once, asked for every shape."""

    views: Sequence["_Cells"]
    seen: Float[Tensor, "cells"]  # by how many views

    @staticmethod
    def of(cameras: Sequence[Camera]) -> "Consensus":
        places = cells_about(CELLS, cameras[0].intrinsics.device)
        views = [_Cells.of(camera, places[places.norm(dim=-1) < 1]) for camera in cameras]
        return Consensus(views, torch.stack([view.inside for view in views]).sum(0).float())

    def agreed(self, likely: Sequence[Bool[Tensor, "_ _"]]) -> list[Bool[Tensor, "_ _"]]:
        """Pixels that show places which most views allow, by what is likely the object in each."""
        left_out = torch.zeros_like(self.seen)
        for view, mask in zip(self.views, likely, strict=True):
            left_out += view.inside & ~mask.reshape(-1)[view.pixel]
        solid = let_by(self.seen, left_out, len(self.views), DISAGREE)
        return [view.shown(solid) for view in self.views]


@dataclass(frozen=True)
class _Cells:
    """Which pixel of a camera's image each cell is at, and how deep."""

    camera: Camera
    inside: Bool[Tensor, "cells"]
    pixel: Int[Tensor, "cells"]  # along its rows; the first for cells that are not inside
    depth: Float[Tensor, "cells"]

    @staticmethod
    def of(camera: Camera, places: Float[Tensor, "cells 3"]) -> "_Cells":
        pixels, depth = camera.project(places)
        inside = camera.shows(pixels, depth)
        column, row = pixels.masked_fill(~inside[:, None], 0.0).long().T
        return _Cells(camera, inside, row * camera.width + column, depth)

    def shown(self, solid: Bool[Tensor, "cells"]) -> Bool[Tensor, "height width"]:
        """Where the camera sees cells that are solid."""
        camera, within = self.camera, solid & self.inside
        shown = self.depth.new_zeros(camera.height, camera.width)
        shown.view(-1)[self.pixel[within]] = 1.0
        if not within.any():
            return shown.bool()
        cell = math.sqrt(3) / CELLS * float(camera.intrinsics[0, 0] / self.depth[within].min())  # half a diagonal
        reach = min(math.ceil(cell), max(camera.height, camera.width))
        return _spread(_spread(shown, reach).T, reach).T > 0


def _spread(shown: Float[Tensor, "rows columns"], reach: int) -> Float[Tensor, "rows columns"]:
    """To as many columns on both sides; rows and columns one after the other take less time than a large square."""
    return max_pool1d(pad(shown, (reach, reach)), 2 * reach + 1, 1)
