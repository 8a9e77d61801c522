"""The page and the picture of `bench views`: the summary, and the worst views as pictures."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from distrace import shading, surface
from distrace.benchmarks import agreement
from distrace.benchmarks.agreement import Measured, Summary, ViewRow
from distrace.benchmarks.measuring import OUTLIER
from distrace.benchmarks.pages import cells
from distrace.benchmarks.random_views import Mixture
from distrace.report.completion_page import View as Rendered
from distrace.report.page import figure, key, page, paragraph, row, section, short, table
from distrace.shading import Picture

SIDE = 256  # pixels; smaller pictures are enlarged towards it
MARGIN = 4  # pixels around the object
COLOURS = {"both": shading.AGREE, "missed": shading.MISSING, "added": shading.EXTRA}
BAR = (
    f"A view passes with an IoU of at least {agreement.LEAST_IOU}, no connected loss above {agreement.LARGEST_LOSS}"
    f" pixels, and at most one depth in {agreement.OFF_EACH} off by more than {OUTLIER:g}. An object of fewer than"
    f" {agreement.SMALL} pixels needs at most {agreement.WRONG} wrong pixels instead of the IoU. A model passes if all"
    f" of its views do, with a median IoU of at least {agreement.LEAST_MEDIAN}."
)


def agreement_page(
    strategy: str, seed: int, found: Sequence[Summary], rows: Sequence[ViewRow], worst: Sequence[Measured]
) -> str:
    """Returns the page: a summary of each model, pictures of the worst views, and every view that fails."""
    failing = [_line(line) for line in rows if line.fails]
    pictures = [
        row(*(figure(picture, words) for picture, words in zip(pictures_of(measured), _captions(measured.row))))
        for measured in worst
    ]
    return page(
        "Random views against the reference",
        f"{len(rows) - len(failing)} of {len(rows)} random views pass. Strategy: {strategy}; seed: {seed}.",
        [
            section("Which models pass?", table(*cells(found)), paragraph(BAR)),
            section("Which views are worst?", key(COLOURS), *pictures),
            section("Which views fail?", table(*cells(failing)) if failing else paragraph("None.")),
        ],
    )


def worst_picture(worst: Sequence[Measured]) -> Picture:
    """Returns one line for each view: the reference, the rendering, and the difference of their masks."""
    return shading.grid([pictures_of(measured) for measured in worst])


def pictures_of(measured: Measured) -> list[Picture]:
    """Returns the shaded reference, the shaded rendering, and the difference of their masks.

    The pictures are cropped to the object in either, and enlarged where it is small.
    """
    visible = torch.isfinite(measured.truth)
    with torch.no_grad():
        rendered = Rendered.of(measured.buffers).shaded
    masks = shading.mask_comparison(visible, measured.buffers.mask)
    crop = _crop(visible | measured.buffers.mask)
    times = max(1, SIDE // max(masks[crop].shape))
    pictures = (_shaded_reference(measured), rendered, masks)
    return [picture[crop].repeat(times, 0).repeat(times, 1) for picture in pictures]


def _crop(mask: Bool[Tensor, "height width"]) -> tuple[slice, slice]:
    """Returns the rows and columns of a mask with a margin; all of them for an empty mask."""
    pixels = mask.nonzero()
    if not len(pixels):
        return slice(None), slice(None)
    (top, left), (bottom, right) = pixels.amin(0).tolist(), pixels.amax(0).tolist()
    return slice(max(0, top - MARGIN), bottom + MARGIN + 1), slice(max(0, left - MARGIN), right + MARGIN + 1)


def described(code: int | Mixture | None) -> str:
    """Returns a code in words: its number, or the parts of a mixture."""
    if isinstance(code, Mixture):
        return f"{1 - code.share:.2f} · {code.first} + {code.share:.2f} · {code.second}"
    return "" if code is None else str(code)


def _shaded_reference(measured: Measured) -> Picture:
    visible = torch.isfinite(measured.truth)
    rays = measured.buffers.rays.detach()
    distance = measured.truth / measured.buffers.cosines
    normal = torch.zeros_like(rays.directions)
    with torch.no_grad():
        normal[visible] = surface.normals(measured.view.sdf, rays[visible].at(distance[visible]))
    return shading.shaded_picture(normal, visible, rays.directions)


def _captions(line: ViewRow) -> tuple[str, str, str]:
    shot = line.camera
    camera = f"{shot.azimuth:.0f}°, {shot.elevation:.0f}°, distance {shot.distance:.2f}, {shot.focal_mm:.0f} mm"
    reference = f"{line.model} {described(line.code)}: {camera}, {shot.size} × {shot.size}, {line.pixels:,} pixels"
    wrong = f"{line.missed:,} missed, {line.added:,} added, IoU {line.iou:.4f}, {line.off:,} depths off"
    return reference, f"{line.strategy}: {line.per_pixel:.1f} evaluations a pixel", wrong


def _line(line: ViewRow) -> dict[str, str]:
    shot = line.camera
    numbers = ("pixels", "missed", "added", "iou", "largest_loss", "off", "exhausted")
    return {
        "model": line.model,
        "code": described(line.code),
        "azimuth": f"{shot.azimuth:.1f}",
        "elevation": f"{shot.elevation:.1f}",
        "distance": f"{shot.distance:.2f}",
        "focal mm": f"{shot.focal_mm:.0f}",
        "size": str(shot.size),
        **{name: short(getattr(line, name)) for name in numbers},
        "fails": ", ".join(line.fails),
    }
