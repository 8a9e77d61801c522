"""A shape from the silhouettes of photographs, whose placement is known."""

from collections.abc import Sequence

import torch

from distrace.checkpoints.model import Model
from distrace.data.observation import View
from distrace.data.photograph import Photograph
from distrace.fitting.fit_code import fit_code
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
