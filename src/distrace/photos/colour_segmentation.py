"""Which pixels show the object, told by colour and grain: histograms of where it is thought to be and where not.

After Prisacariu and Reid, *PWP3D*, IJCV 2012, section 3: no mask is needed, and a rough shape is enough to begin with.
By colours alone a grey wing before a grey wall would be wall; but its grain is another.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv3d, grid_sample, max_pool2d

BINS = 16  # of each channel
GRAINS = (0.01, 0.03)  # standard deviations of brightness that part what is even, uneven, and rough …
GRAIN = 3  # … across so many pixels
AROUND = 5  # pixels, across which neighbours speak for each other
LEAST = 0.02  # probability, of anything
PRIOR = 1e-4  # of a colour, in each histogram: what was hardly seen in either says nothing


def appearance(image: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 4"]:
    """Colours, and how rough the image is about them: 0, 1 or 2.

    That is by the evenest of the windows that hold a pixel: an outline beside it does not make it rough.
    """
    grey = image.mean(-1)[None, None]
    mean, squares = (avg_pool2d(of, GRAIN, 1, GRAIN // 2, count_include_pad=False) for of in (grey, grey.square()))
    deviation = -max_pool2d(-(squares - mean.square()).clamp_min(0).sqrt(), GRAIN, 1, GRAIN // 2)[0, 0]
    return torch.cat([image, torch.bucketize(deviation, torch.tensor(GRAINS).to(image))[..., None]], dim=-1)


@dataclass(frozen=True)
class Regions:
    """The probability that what looks so is the object: for each grain a cube of colours."""

    of_object: Float[Tensor, "grains bins bins bins"]

    @staticmethod
    def of(looks: Float[Tensor, "n 4"], is_object: Bool[Tensor, "n"]) -> "Regions":
        """From pixels that are thought to be the object's, and others. Without one of them nothing is told."""
        inside, outside = (_histogram(looks[some]) + PRIOR for some in (is_object, ~is_object))
        told = inside / (inside + outside)
        return Regions(told if is_object.any() and not is_object.all() else torch.full_like(told, 0.5))

    def probability(self, looks: Float[Tensor, "n 4"]) -> Float[Tensor, "n"]:
        """That pixels of some appearance show the object."""
        grid = (2 * looks[:, :3] - 1)[None, None, None].flip(-1)  # grid_sample's x is the last axis
        found = grid_sample(self.of_object[None], grid, padding_mode="border", align_corners=False)
        return found.reshape(len(self.of_object), -1).gather(0, looks[None, :, 3].long())[0]

    def smooth_probability(self, looks: Float[Tensor, "height width 4"]) -> Float[Tensor, "height width"]:
        """That pixels show the object, by the mean log odds around them: parts may look like the background.

        Where a pixel's own odds disagree with that, nothing is told: a leg of a pixel's width is all outline.
        """
        odds = self.probability(looks.reshape(-1, 4)).clamp(LEAST, 1 - LEAST).logit().reshape(1, 1, *looks.shape[:2])
        around = avg_pool2d(odds, AROUND, 1, AROUND // 2, count_include_pad=False)
        return torch.where(odds * around < 0, 0.0, around)[0, 0].sigmoid()


def _histogram(looks: Float[Tensor, "n 4"]) -> Float[Tensor, "grains bins bins bins"]:
    """Shares, smoothed over neighbouring bins."""
    red, green, blue = (looks[:, :3] * BINS).long().clamp(0, BINS - 1).T
    grains = 1 + len(GRAINS)
    flat = ((looks[:, 3].long() * BINS + red) * BINS + green) * BINS + blue
    counts = torch.bincount(flat, minlength=grains * BINS**3).reshape(grains, 1, BINS, BINS, BINS).to(looks)
    kernel = torch.tensor([1.0, 2.0, 1.0]).to(looks) / 4
    for axis in range(3):
        shape, padding = [1, 1, 1, 1, 1], [0, 0, 0]
        shape[2 + axis], padding[axis] = 3, 1
        counts = conv3d(counts, kernel.reshape(shape), padding=padding)
    return counts[:, 0] / max(len(looks), 1)
