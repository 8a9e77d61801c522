"""What residuals of a code are measured on: rays of all views, and what was seen along them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.fitting.ray_sampling import Targets
from distrace.losses import Weights
from distrace.rays import Bounds, Rays, meet_sphere


@dataclass(frozen=True)
class Seen:
    """Rays of all views, and what was seen there. A weight is a ray's share of its term of the loss."""

    rays: Rays
    bounds: Bounds
    observed: Float[Tensor, "n"]  # distance; `inf` where unknown
    is_object: Bool[Tensor, "n"]
    weights: Float[Tensor, "n"]
    touches: Bool[Tensor, "n"]  # of object rays: along the outline, where the field is to vanish, not to be below zero
    noise: Float[Tensor, "n"]  # the standard deviation of depths; 0 where too small to be told, or where there is none

    @staticmethod
    def of(targets: Sequence[Targets], weights: Weights, noises: Sequence[float] | None = None) -> "Seen":
        """Of each view what it targets, and how noisy its depths are: not at all, if nothing is said."""
        parts = []
        for target, noise in zip(targets, noises or [0.0] * len(targets), strict=True):
            rays, known = target.camera.rays(target.pixels), target.depth.isfinite()
            depth, mask = weights.depth / max(int(known.sum()), 1), weights.mask / max(len(known), 1)
            share = torch.where(known, depth, mask) / len(targets)
            observed = target.depth / target.camera.cosines(target.pixels)
            noisy = known * target.depth.new_tensor(noise)
            parts.append((rays.origins, rays.directions, observed, target.is_object, share, target.touches, noisy))
        origins, directions, *others = (torch.cat(part) for part in zip(*parts))
        rays = Rays(origins, directions)
        return Seen(rays, meet_sphere(rays), *others)

    @property
    def known(self) -> Bool[Tensor, "n"]:
        return self.observed.isfinite()

    def __getitem__(self, rows: Tensor) -> "Seen":
        bounds = Bounds(self.bounds.near[rows], self.bounds.far[rows])
        images = (self.observed, self.is_object, self.weights, self.touches, self.noise)
        return Seen(self.rays[rows], bounds, *(image[rows] for image in images))
