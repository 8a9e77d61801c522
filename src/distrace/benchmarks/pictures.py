"""Pictures of `bench`: evaluations of each pixel, and random views beside their references."""

import torch
from jaxtyping import Bool
from torch import Tensor

from distrace import shading, surface
from distrace.antialiasing import clay_picture
from distrace.benchmarks.agreement import Measured
from distrace.render import Buffers
from distrace.shading import Picture

MAPPED = ("coarse_to_fine", "fast", "fast_next")
MOST_QUERIES = 20.0  # the strongest colour
SIDE = 256  # pixels; smaller pictures of views are enlarged towards it
MARGIN = 4  # pixels around the object


def query_map(buffers: Buffers) -> Picture:
    """Returns the evaluations of each ray as colours; white where there are none."""
    evaluations = buffers.trace.evaluations.float()
    return shading.error_picture(evaluations.masked_fill(evaluations == 0, float("nan")), MOST_QUERIES)


def pictures_of(measured: Measured) -> list[Picture]:
    """Returns the shaded reference, the shaded rendering, and the difference of their masks.

    The pictures are cropped to the object in either, and enlarged where it is small.
    """
    buffers = measured.buffers
    visible = torch.isfinite(measured.truth)
    rays = buffers.rays.detach()
    distance = measured.truth / buffers.cosines
    normal = torch.zeros_like(rays.directions)
    with torch.no_grad():
        normal[visible] = surface.normals(measured.view.sdf, rays[visible].at(distance[visible]))
    reference = shading.shaded_picture(normal, visible, rays.directions)
    crop = _crop(visible | buffers.mask)
    times = max(1, SIDE // max(visible[crop].shape))
    pictures = (reference, clay_picture(buffers), shading.mask_comparison(visible, buffers.mask))
    return [picture[crop].repeat(times, 0).repeat(times, 1) for picture in pictures]


def _crop(mask: Bool[Tensor, "height width"]) -> tuple[slice, slice]:
    """Returns the rows and columns of a mask with a margin; all of them for an empty mask."""
    pixels = mask.nonzero()
    if not len(pixels):
        return slice(None), slice(None)
    (top, left), (bottom, right) = pixels.amin(0).tolist(), pixels.amax(0).tolist()
    return slice(max(0, top - MARGIN), bottom + MARGIN + 1), slice(max(0, left - MARGIN), right + MARGIN + 1)
