"""`multiview --colour`: a shape's colours and the light on it, from photographs."""

from collections.abc import Sequence

import numpy as np

from distrace.checkpoints.colours import Colours
from distrace.checkpoints.model import Model
from distrace.cli.console import Run, progress
from distrace.data.photograph import Photograph
from distrace.files import atomic_write
from distrace.fitting.fit_colours import ColourFit, ColourFitConfig, fit_colours
from distrace.photos.fit_photos import PhotoStep


def find_colours(
    run: Run, model: Model, colours: Colours, views: Sequence[Photograph], step: PhotoStep, same_light: bool
) -> ColourFit:
    """Returns the colours of a fitted shape, and the light on it; writes `colour.npy`."""
    config = ColourFitConfig()
    field = model.field(step.code)
    with progress("fitting colours", config.steps) as bar:

        def advance(done: int) -> None:
            bar.advance("", to=done)

        found = fit_colours(colours, views, field, step.code, step.place, config, same_light, advance)
    with atomic_write(run.out / "colour.npy") as file:
        np.save(file, found.colour_code.cpu().numpy())
    return found
