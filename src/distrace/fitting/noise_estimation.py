"""How noisy depths are, told from the view alone: how far each is from the plane through its neighbours."""

from math import pi, sqrt
from statistics import NormalDist

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.observation import View

NEIGHBOURS = 8
REACH = 0.08  # in the units of the unit sphere: over more than that shapes are no planes
ASKED, LEAST = 2000, 100  # depths at most, and at least: of fewer nothing is told
SHARE = 0.25  # of deviations: as quartiles, not medians, tell them, every tenth depth may be wrong
TELLING = 0.025  # noise below this is none: shapes are bent, and a tenth of a view's depths lie far apart


def noise_of(view: View) -> float:
    """The standard deviation of a view's depths about the surface; 0 where it is too small, or depths too few, to tell.

    Second differences tell the noise of pictures (Immerkær, *Computer Vision and Image Understanding* 1996); here
    neighbours lie anywhere, and quartiles leave edges and outliers aside.
    """
    from scipy.spatial import KDTree

    seen = view.seen.cpu()
    pixels, depths = seen.nonzero().double().numpy(), view.depth.cpu()[seen].double().numpy()
    if len(depths) < LEAST:
        return 0.0
    asked = np.linspace(0, len(depths) - 1, min(ASKED, len(depths))).astype(int)
    apart, near = map(np.asarray, KDTree(pixels).query(pixels[asked], NEIGHBOURS + 1))
    close = apart[:, -1] * depths[asked] < REACH * float(view.camera.intrinsics[0, 0])
    if close.sum() < LEAST:
        return 0.0
    here, near = asked[close], near[close, 1:]
    weights = _of_planes(pixels[near] - pixels[here, None])
    off = depths[here] - (weights * depths[near]).sum(1)
    off /= np.sqrt(1 + np.square(weights).sum(1))  # what the neighbours' own noise adds
    found = float(np.quantile(np.abs(off), SHARE) / NormalDist().inv_cdf((1 + SHARE) / 2))
    return found if found > TELLING else 0.0


def _of_planes(offsets: Float[np.ndarray, "n neighbours 2"]) -> Float[np.ndarray, "n neighbours"]:
    """What each neighbour counts for the value, at the middle, of the plane that is nearest to all."""
    ones = np.ones((*offsets.shape[:2], 1))
    return np.linalg.pinv(np.concatenate([offsets, ones], axis=-1))[:, -1]


def expected(noise: Float[Tensor, "n"], most: float) -> Float[Tensor, "n"]:
    """The mean of |x|, but at most `most`, over Gaussian noise of these standard deviations."""
    level = most / noise.clamp_min(1e-9)
    return noise * sqrt(2 / pi) * (1 - (-level.square() / 2).exp()) + most * torch.erfc(level / sqrt(2))
