"""The page of a shape fitted to photographs: photographs beside renderings, and a film of the fit."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from distrace.antialiasing import clay_picture
from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.coloured import coloured_picture, studio
from distrace.data.photograph import Photograph
from distrace.fields.colour import Albedo
from distrace.fitting.ray_sampling import band
from distrace.lights import Light
from distrace.photos.fit_photos import PhotoStep
from distrace.photos.judge import ViewAgreement
from distrace.render import Buffers, render
from distrace.report.charts import curves
from distrace.report.page import Html, figure, page, paragraph, row, section, table
from distrace.report.scene import space_section
from distrace.shading import EXTRA, Picture, colour_picture, side_by_side

if TYPE_CHECKING:
    import trimesh

SHOWN = 8  # views on the page
SIZE = 224  # pixels along a picture's longer side
FRAMES = 24  # of the film


def views_page(
    model: Model,
    views: Sequence[Photograph],
    steps: Sequence[PhotoStep],
    agreed: Sequence[ViewAgreement],
    mesh: "trimesh.Trimesh",
    coloured: Sequence[Sequence[Picture]] = (),
) -> str:
    """Returns a page with photographs under the outline of the fitted shape, the shape, and each view's error.

    `coloured` holds rows of pictures of the shape in its colours, where they are known.
    """
    last = steps[-1]
    examples = views[:: -(-len(views) // SHOWN)]
    pictures = [figure(_beside(model, last, view), view.name) for view in examples]
    losses: dict[str, list[float]] = {}
    for step in steps:
        losses.setdefault(step.name, []).append(step.loss)
    cells = [[view.name, f"{view.colour:.3f}", "doubtful" if view.is_outlier else ""] for view in agreed]
    counted = "one photograph" if len(views) == 1 else f"{len(views)} photographs"
    lead = f"A shape from {counted} without depth, by the model {model.name}."
    about = "Median difference of colours, from 0 to 1, between a view and the other views of the same points."
    colours: list[Html] = []
    if coloured:
        note = "A photograph; the shape in the colours and the light that were found; and in another light."
        rows = [figure(side_by_side(each), view.name) for each, view in zip(coloured, views)]
        colours = [section("Colours", paragraph(note), row(*rows))]
    return page(
        "A shape from photographs",
        lead,
        [
            section("Views", paragraph("Photographs with the shape's outline, and the shape."), row(*pictures)),
            *colours,
            space_section({"Shape": mesh}),
            *([section("Loss", curves(losses, "iteration", "loss", True, last.name))] if len(steps) > 1 else []),
            *([section("Agreement", paragraph(about), table(["view", "colour", ""], cells))] if cells else []),
        ],
    )


def forming(model: Model, steps: Sequence[PhotoStep], camera: Camera) -> UInt8[np.ndarray, "frames height width 3"]:
    """Returns renderings of the shape during the best start of the fit, the last step included."""
    best = [step for step in steps if step.start == steps[-1].start]
    frames = [*best[:: -(-len(best) // FRAMES)], best[-1]]
    return np.stack([clay_picture(_rendered(model, step, camera)) for step in frames])


def _beside(model: Model, step: PhotoStep, view: Photograph) -> Picture:
    """Returns the photograph with the outline of the shape, beside the shape."""
    small = view.at_most(SIZE)
    buffers = _rendered(model, step, view.camera)
    picture = colour_picture(small.image.cpu())
    picture[band(buffers.mask, 3).cpu().numpy()] = EXTRA
    return side_by_side([picture, clay_picture(buffers)])


@torch.no_grad()
def colours_beside(model: Model, view: Photograph, step: PhotoStep, albedo: Albedo, light: Light) -> list[Picture]:
    """Returns a photograph, the coloured shape in the light that was found for it, and in a studio's."""
    small = view.at_most(SIZE)
    buffers = _rendered(model, step, view.camera)

    def found(points: Tensor, normals: Tensor) -> Tensor:
        return light(points, step.place.turned(normals))

    pictures = [coloured_picture(buffers, albedo, lights) for lights in ([found], studio(buffers))]
    return [colour_picture(small.image.cpu()), *pictures]


@torch.no_grad()
def _rendered(model: Model, step: PhotoStep, camera: Camera) -> Buffers:
    small = camera.resized(min(1.0, SIZE / max(camera.height, camera.width)))
    return render(model.field(step.code), step.place.camera_in_object(small))
