"""`multiview --colour`: a shape's colours and the light on it, from photographs."""

from collections.abc import Sequence

import numpy as np
import torch

from distrace.checkpoints.colours import Colours
from distrace.checkpoints.model import Model
from distrace.cli.console import Run, progress
from distrace.data.observation import View
from distrace.data.photograph import Photograph
from distrace.files import atomic_write
from distrace.fitting.fit_code import fit_code
from distrace.fitting.fit_colours import ColourFit, ColourFitConfig, fit_colours
from distrace.photos.fit_photos import PhotoFit, PhotoStep
from distrace.pose import Similarity
from distrace.prior import prior_of


def shape_of_silhouettes(model: Model, photographs: Sequence[Photograph]) -> PhotoFit:
    """Returns the shape of photographs with masks, placed as the model's shapes are.

    Raises `ValueError` for a photograph without a mask.
    """
    views = []
    for photograph in photographs:
        mask = photograph.known_mask
        views.append(View(photograph.camera, photograph.image.new_full(mask.shape, torch.inf), mask))
    fit = fit_code(model.decoder, views, prior_of(model.codes))
    step = PhotoStep(0, 1, fit.loss, {"outline": fit.loss}, fit.code, Similarity.identity().to(fit.code.device))
    return PhotoFit([step], fit.evaluations)


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
