"""What looks like the object in one view, and can be it by the others: a neighbour of its colour is there only once.

After Campbell et al., *Automatic 3D object segmentation in multiple views using volumetric graph-cuts* (BMVC 2007),
whose cut is a vote of the views here.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.photographs.hull import allowed

CELLS = 48  # along each axis of the cube around the unit sphere
DISAGREE = 0.15  # of the views that see a place may take it for the background: parts look like that


def agreed(photographs: Sequence[Photograph], likely: Sequence[Bool[Tensor, "_ _"]]) -> list[Bool[Tensor, "_ _"]]:
    """Pixels that show places which most views allow, by what is likely the object in each."""
    places, solid = allowed(
        [replace(each, mask=mask) for each, mask in zip(photographs, likely, strict=True)], CELLS, DISAGREE
    )
    return [_shown(each.camera, places[solid]) for each in photographs]


def _shown(camera: Camera, places: Float[Tensor, "places 3"]) -> Bool[Tensor, "height width"]:
    """Where a camera sees cells about places."""
    pixels, depth = camera.project(places)
    within = camera.shows(pixels, depth)
    column, row = pixels[within].long().T
    shown = places.new_zeros(camera.height, camera.width)
    shown[row, column] = 1.0
    if not within.any():
        return shown.bool()
    cell = math.sqrt(3) / CELLS * float(camera.intrinsics[0, 0] / depth[within].min())  # half a diagonal, in pixels
    reach = min(math.ceil(cell), max(camera.height, camera.width))
    return _spread(_spread(shown, reach).T, reach).T > 0


def _spread(shown: Float[Tensor, "rows columns"], reach: int) -> Float[Tensor, "rows columns"]:
    """To as many columns on both sides; rows and columns one after the other take less time than a large square."""
    return max_pool1d(pad(shown, (reach, reach)), 2 * reach + 1, 1)
