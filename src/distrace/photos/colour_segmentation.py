"""Segments pixels into object and background by histograms of colour and roughness.

After Prisacariu and Reid, *PWP3D*, IJCV 2012, section 3: a rough shape is enough to begin with, and no mask is needed.
Roughness separates a grey wing from a grey wall.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool3d, grid_sample, max_pool2d

from distrace.photos.stereo_pairs import window_mean, window_moments

BINS = 16  # of each colour channel
ROUGHNESS_LEVELS = (0.01, 0.03)  # standard deviations of brightness between smooth, uneven and rough …
ROUGHNESS_WINDOW = 3  # … in a window of so many pixels
SMOOTHING_WINDOW = 5  # pixels, over which log odds are averaged
LEAST_PROBABILITY = 0.02
PRIOR_SHARE = 1e-4  # of each bin in both histograms, so that a rare colour says nothing


def appearance(image: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 4"]:
    """Colours, and the roughness of the image about each pixel: 0, 1 or 2.

    The smoothest window that holds a pixel counts: an outline beside it does not make it rough.
    """
    _, variance = window_moments(image.mean(-1)[None], ROUGHNESS_WINDOW)
    smoothest = -max_pool2d(-variance.sqrt()[None], ROUGHNESS_WINDOW, 1, ROUGHNESS_WINDOW // 2)[0, 0]
    roughness = torch.bucketize(smoothest, torch.tensor(ROUGHNESS_LEVELS).to(image))
    return torch.cat([image, roughness[..., None]], dim=-1)


@dataclass(frozen=True)
class ColourModel:
    """The probability that a pixel of some appearance shows the object: a cube of colours for each roughness."""

    probabilities: Float[Tensor, "roughness bins bins bins"]

    @staticmethod
    def of(appearances: Float[Tensor, "n 4"], is_object: Bool[Tensor, "n"]) -> "ColourModel":
        """The model of pixels that are labelled object or background; 0.5 everywhere where one label is missing."""
        inside = _histogram(appearances[is_object]) + PRIOR_SHARE
        outside = _histogram(appearances[~is_object]) + PRIOR_SHARE
        found = inside / (inside + outside)
        both = is_object.any() and not is_object.all()
        return ColourModel(found if both else torch.full_like(found, 0.5))

    def probability(self, appearances: Float[Tensor, "n 4"]) -> Float[Tensor, "n"]:
        """The probability that each pixel shows the object, by its own appearance."""
        grid = (2 * appearances[:, :3] - 1)[None, None, None].flip(-1)  # grid_sample's x is the last axis
        found = grid_sample(self.probabilities[None], grid, padding_mode="border", align_corners=False)
        return found.reshape(len(self.probabilities), -1).gather(0, appearances[None, :, 3].long())[0]

    def smooth_probability(self, appearances: Float[Tensor, "height width 4"]) -> Float[Tensor, "height width"]:
        """The probability by the mean log odds of a window, since parts of an object may look like the background.

        It is 0.5 where a pixel's own odds disagree with its window's: a leg one pixel wide is all outline.
        """
        own = self.probability(appearances.reshape(-1, 4)).clamp(LEAST_PROBABILITY, 1 - LEAST_PROBABILITY)
        odds = own.logit().reshape(1, *appearances.shape[:2])
        mean = window_mean(odds, SMOOTHING_WINDOW)
        return torch.where(odds * mean < 0, 0.0, mean)[0].sigmoid()


def _histogram(appearances: Float[Tensor, "n 4"]) -> Float[Tensor, "roughness bins bins bins"]:
    """Shares of pixels, smoothed over neighbouring colours."""
    red, green, blue = (appearances[:, :3] * BINS).long().clamp(0, BINS - 1).T
    levels = 1 + len(ROUGHNESS_LEVELS)
    bin_index = ((appearances[:, 3].long() * BINS + red) * BINS + green) * BINS + blue
    counts = torch.bincount(bin_index, minlength=levels * BINS**3).reshape(levels, BINS, BINS, BINS).to(appearances)
    smooth = avg_pool3d(avg_pool3d(counts, 2, 1, 1), 2, 1)  # two pairs make the weights 1, 2, 1
    return smooth / max(len(appearances), 1)
