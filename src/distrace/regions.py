"""Which pixels show the object, told by their colours alone: histograms of where it is thought to be and where not.

After Prisacariu and Reid, *PWP3D*, IJCV 2012, section 3: no mask is needed, and a rough shape is enough to begin with.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv3d, grid_sample

BINS = 16  # of each channel
AROUND = 5  # pixels, across which neighbours speak for each other
LEAST = 0.02  # probability, of anything
PRIOR = 1e-4  # of a colour, in each histogram: what was hardly seen in either says nothing


@dataclass(frozen=True)
class Regions:
    """The probability that a colour is the object's, over a cube of colours."""

    of_object: Float[Tensor, "bins bins bins"]

    @staticmethod
    def of(colours: Float[Tensor, "n 3"], is_object: Bool[Tensor, "n"]) -> "Regions":
        """From colours that are thought to be the object's, and others. Without one of them nothing is told."""
        inside, outside = (_histogram(colours[some]) + PRIOR for some in (is_object, ~is_object))
        return Regions(inside / (inside + outside))

    def probability(self, colours: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """That pixels of some colours show the object."""
        grid = (2 * colours - 1)[None, None, None].flip(-1)  # grid_sample's x is the last axis
        cube = self.of_object[None, None]
        return grid_sample(cube, grid, padding_mode="border", align_corners=False).reshape(-1)

    def smooth_probability(self, image: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width"]:
        """That pixels show the object, by the mean log odds around them: parts may have colours of the background."""
        odds = self.probability(image.reshape(-1, 3)).clamp(LEAST, 1 - LEAST).logit().reshape(1, 1, *image.shape[:2])
        return avg_pool2d(odds, AROUND, 1, AROUND // 2, count_include_pad=False)[0, 0].sigmoid()


def _histogram(colours: Float[Tensor, "n 3"]) -> Float[Tensor, "bins bins bins"]:
    """Shares, smoothed over neighbouring bins."""
    bins = (colours * BINS).long().clamp(0, BINS - 1)
    flat = (bins[:, 0] * BINS + bins[:, 1]) * BINS + bins[:, 2]
    counts = torch.bincount(flat, minlength=BINS**3).reshape(1, 1, BINS, BINS, BINS).to(colours)
    kernel = torch.tensor([1.0, 2.0, 1.0]).to(colours) / 4
    for axis in range(3):
        shape, padding = [1, 1, 1, 1, 1], [0, 0, 0]
        shape[2 + axis], padding[axis] = 3, 1
        counts = conv3d(counts, kernel.reshape(shape), padding=padding)
    return counts[0, 0] / max(len(colours), 1)
