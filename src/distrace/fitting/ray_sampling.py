"""Which rays of an observed view a loss looks at, and what it expects there."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.fields.base import SDF
from distrace.rays import meet_sphere

OUTLINE = 9  # pixels across the band in which half of the silhouette's rays are drawn


@dataclass(frozen=True)
class Targets:
    """Rays of one camera: a depth (`inf` if unknown), whether the object is there, and a normal (zero if unknown)."""

    camera: Camera
    pixels: Float[Tensor, "n 2"]
    depth: Float[Tensor, "n"]
    is_object: Bool[Tensor, "n"]
    normal: Float[Tensor, "n 3"] | None


@dataclass(frozen=True)
class Pool:
    """The pixels of a view that targets are drawn from, as flat indices."""

    view: View
    with_depth: Tensor  # or with a normal, where that is all there is
    outline: Tensor
    anywhere: Tensor  # whose rays meet the unit sphere

    @staticmethod
    def of(view: View) -> "Pool":
        nothing = torch.empty(0, dtype=torch.int64, device=view.depth.device)
        with_depth = view.seen.reshape(-1).nonzero()[:, 0]
        if view.mask is None:
            known = with_depth if len(with_depth) else view.observed.reshape(-1).nonzero()[:, 0]
            return Pool(view, known, nothing, nothing)
        meets = meet_sphere(view.camera.rays()).meets
        outline, anywhere = ((region & meets).reshape(-1).nonzero()[:, 0] for region in (band(view.mask), meets))
        return Pool(view, with_depth, outline, anywhere)

    def draw(self, depth_rays: int, mask_rays: int, random: torch.Generator) -> Targets:
        """Returns at most so many rays with a depth, and of the silhouette: half at its outline, half anywhere."""
        sets = ((self.with_depth, depth_rays), (self.outline, mask_rays // 2), (self.anywhere, mask_rays // 2))
        chosen = torch.cat([drawn(indices, count, random) for indices, count in sets])
        view = self.view
        is_object = view.observed.reshape(-1)[chosen]
        normal = None if view.normal is None else view.normal.reshape(-1, 3)[chosen]
        pixels = view.camera.pixels().reshape(-1, 2)[chosen]
        depth = view.depth.reshape(-1)[chosen]
        return Targets(view.camera, pixels, depth, is_object, normal)


@torch.no_grad()
def pools_of(mean: SDF, views: Sequence[View], device: torch.device) -> list[Pool]:
    """Returns the pool of each view.

    Raises `ValueError` without views, or with one from inside the mean shape: nothing is hit from there.
    """
    if not views:
        raise ValueError("no view was given; fitting needs at least one")
    eyes = torch.stack([view.camera.T_world_camera[:3, 3] for view in views])
    values = mean(eyes.to(device))
    if (values < 0).any():
        eye = [round(x, 3) for x in eyes[int(values.argmin())].tolist()]
        raise ValueError(
            f"the camera at {eye} is inside the mean shape; shapes are seen from outside, about the origin"
        )
    return [Pool.of(view) for view in views]


def band(mask: Bool[Tensor, "height width"], width: int = OUTLINE) -> Bool[Tensor, "height width"]:
    """The pixels on both sides of a mask's outline; `width` is odd."""
    inner = mask[None].float()
    return (max_pool2d(inner, width, 1, width // 2) != -max_pool2d(-inner, width, 1, width // 2))[0]


def middles(mask: Bool[Tensor, "height width"], centres: Float[Tensor, "height width 2"]) -> Float[Tensor, "n 2"]:
    """Between pixels of the object and of the background beside them: there the outline is, to half a pixel."""
    found = []
    for axis in (0, 1):
        length = mask.shape[axis] - 1
        (first, second), (here, there) = ([image.narrow(axis, k, length) for k in (0, 1)] for image in (mask, centres))
        found.append(((here + there) / 2)[first != second])
    return torch.cat(found)


def drawn(indices: Tensor, count: int, random: torch.Generator) -> Tensor:
    """At most `count` of them, at random."""
    return indices[torch.randperm(len(indices), generator=random)[:count]]
