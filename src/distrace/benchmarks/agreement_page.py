"""The page and the picture of `bench views`: the summary, and the worst views as pictures."""

from collections.abc import Sequence
from dataclasses import asdict

import torch
from jaxtyping import Bool
from torch import Tensor

from distrace import shading, surface
from distrace.benchmarks.agreement import (
    LARGEST_LOSS,
    LEAST_IOU,
    LEAST_MEDIAN,
    OFF_EACH,
    SMALL,
    WRONG,
    Measured,
    Summary,
    ViewRow,
)
from distrace.benchmarks.random_views import Mixture
from distrace.report.completion_page import View as Rendered
from distrace.report.page import figure, key, page, paragraph, row, section, short, table
from distrace.shading import Picture

SIDE = 256  # pixels; smaller pictures are enlarged towards it
MARGIN = 4  # pixels around what is seen
COLOURS = {"both": shading.AGREE, "missed": shading.MISSING, "added": shading.EXTRA}
BAR = (
    f"A view passes with an IoU of at least {LEAST_IOU} (an object of fewer than {SMALL} pixels: with at most {WRONG}"
    f" wrong pixels), no connected loss of more than {LARGEST_LOSS} pixels, and at most one depth in {OFF_EACH} that is"
    f" off by more than 0.001. A model passes if all of its views do and the median IoU is at least {LEAST_MEDIAN}."
)


def agreement_page(
    strategy: str, seed: int, found: Sequence[Summary], rows: Sequence[ViewRow], worst: Sequence[Measured]
) -> str:
    """The summary of each model, the pictures of the worst views, and every view that misses the bar."""
    failing = [line for line in rows if line.fails]
    lead = f"{len(rows) - len(failing)} of {len(rows)} random views pass. Strategy: {strategy}; seed: {seed}."
    pictures = [
        row(*(figure(picture, words) for picture, words in zip(pictures_of(measured), _captions(measured.row))))
        for measured in worst
    ]
    lines = [_cells(line) for line in failing]
    return page(
        "Random views against the reference",
        lead,
        [
            section("Which models pass?", table(*summary_cells(found)), paragraph(BAR)),
            section("Which views are worst?", key(COLOURS), *pictures),
            section("Which views fail?", table(list(lines[0]), [list(line.values()) for line in lines]))
            if lines
            else section("Which views fail?", paragraph("None.")),
        ],
    )


def summary_cells(found: Sequence[Summary]) -> tuple[list[str], list[list[str]]]:
    """Header and lines of the summary."""
    lines = [asdict(line) for line in found]
    return [name.replace("_", " ") for name in lines[0]], [[short(value) for value in line.values()] for line in lines]


def worst_picture(worst: Sequence[Measured]) -> Picture:
    """One line for each view: the reference, the rendering, and where their masks differ."""
    return shading.grid([pictures_of(measured) for measured in worst])


def pictures_of(measured: Measured) -> list[Picture]:
    """The reference shaded, the rendering shaded, and the difference of their masks.

    They are cropped to what is in either, and enlarged where that is small.
    """
    true = torch.isfinite(measured.truth)
    with torch.no_grad():
        rendered = Rendered.of(measured.buffers).shaded
    pictures = [_shaded_reference(measured), rendered, shading.mask_comparison(true, measured.buffers.mask)]
    part = _around(true | measured.buffers.mask)
    times = max(1, SIDE // max(pictures[0][part].shape))
    return [picture[part].repeat(times, 0).repeat(times, 1) for picture in pictures]


def _around(mask: Bool[Tensor, "height width"]) -> tuple[slice, slice]:
    """The rows and columns of a mask, and a few beside; all where it is empty."""
    found = mask.nonzero()
    if not len(found):
        return slice(None), slice(None)
    (top, left), (bottom, right) = found.amin(0).tolist(), found.amax(0).tolist()
    return slice(max(0, top - MARGIN), bottom + MARGIN + 1), slice(max(0, left - MARGIN), right + MARGIN + 1)


def described(code: int | Mixture | None) -> str:
    """A code in words: its number, or what it is a mixture of."""
    if isinstance(code, Mixture):
        return f"{1 - code.share:.2f} · {code.first} + {code.share:.2f} · {code.second}"
    return "" if code is None else str(code)


def _shaded_reference(measured: Measured) -> Picture:
    true, rays = torch.isfinite(measured.truth), measured.buffers.rays.detach()
    distance = measured.truth / measured.buffers.cosines
    normal = torch.zeros_like(rays.directions)
    with torch.no_grad():
        normal[true] = surface.normals(measured.view.sdf, rays[true].at(distance[true]))
    return shading.shaded_picture(normal, true, rays.directions)


def _captions(line: ViewRow) -> tuple[str, str, str]:
    shot = line.camera
    camera = f"{shot.azimuth:.0f}°, {shot.elevation:.0f}°, distance {shot.distance:.2f}, {shot.focal_mm:.0f} mm"
    seen = f"{line.model} {described(line.code)}: {camera}, {shot.size} × {shot.size}, {line.pixels:,} pixels"
    wrong = f"{line.missed:,} missed, {line.added:,} added, IoU {line.iou:.4f}, {line.off:,} depths off"
    return seen, f"{line.strategy}: {line.per_pixel:.1f} evaluations a pixel", wrong


def _cells(line: ViewRow) -> dict[str, str]:
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
        **{name.replace("_", " "): short(getattr(line, name)) for name in numbers},
        "fails": ", ".join(line.fails),
    }
