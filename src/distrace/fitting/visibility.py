"""Rays of an observed view whose camera is yet to be found: what was seen on each, in the camera's own axes."""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.data.observation import View
from distrace.fitting.ray_sampling import band, drawn, middles
from distrace.pixels import rectangle_around


@dataclass(frozen=True)
class ObservedRays:
    """A depth is `inf` and a normal zero where unknown. A ray of object and background both touches the shape."""

    pixels: Float[Tensor, "n 2"]
    depth: Float[Tensor, "n"]
    is_object: Bool[Tensor, "n"]
    is_background: Bool[Tensor, "n"]
    normal: Float[Tensor, "n 3"]
    outside: Float[Tensor, "n 2"]  # in pixels, from the object's nearest one; zero on the object

    @property
    def has_normal(self) -> Bool[Tensor, "n"]:
        return self.normal.norm(dim=-1) > 0.5

    def __add__(self, other: "ObservedRays") -> "ObservedRays":
        return ObservedRays(
            *(torch.cat([getattr(self, part.name), getattr(other, part.name)]) for part in fields(self))
        )


def rays_of(view: View, count: int, seed: int = 0) -> ObservedRays:
    """A third of the rays each on the object, beside its outline and around it; without a mask all on the object.

    Raises `ValueError` where nothing was observed.
    """
    random = torch.Generator().manual_seed(seed)
    normals = view.depth.new_zeros(*view.depth.shape, 3) if view.normal is None else view.normal
    inside = view.observed
    if not inside.any():
        raise ValueError("the view shows nothing of the object; it needs a depth, a mask or normals")
    regions = [inside] if view.mask is None else [inside, band(view.mask), rectangle_around(view.mask, _half)]
    pixels = [region.reshape(-1).nonzero()[:, 0] for region in regions]
    chosen = torch.cat([drawn(some, count // len(regions), random) for some in pixels])
    is_object = inside.reshape(-1)[chosen]
    return ObservedRays(
        view.camera.pixels().reshape(-1, 2)[chosen],
        view.depth.reshape(-1)[chosen],
        is_object,
        torch.zeros_like(is_object) if view.mask is None else ~is_object,
        normals.reshape(-1, 3)[chosen] @ view.camera.T_world_camera[:3, :3],
        _outside(inside).to(view.depth).reshape(-1, 2)[chosen],
    )


def outline_of(
    mask: Bool[Tensor, "height width"], centres: Float[Tensor, "height width 2"], count: int
) -> ObservedRays:
    """Rays between pixels of the object and of the background beside them: there the outline is, to half a pixel.

    At most `count`, drawn at random.
    """
    pixels = drawn(middles(mask, centres), count, torch.Generator().manual_seed(0))
    every, nothing = torch.ones_like(pixels[:, 0], dtype=torch.bool), pixels.new_zeros(len(pixels), 3)
    return ObservedRays(pixels, torch.full_like(pixels[:, 0], torch.inf), every, every, nothing, nothing[:, :2])


def _outside(inside: Bool[Tensor, "height width"]) -> Float[Tensor, "height width 2"]:
    from scipy.ndimage import distance_transform_edt

    y, x = torch.from_numpy(distance_transform_edt(~inside.cpu().numpy(), return_distances=False, return_indices=True))
    rows, columns = torch.meshgrid(*(torch.arange(size) for size in inside.shape), indexing="ij")
    return torch.stack([columns - x, rows - y], dim=-1).float()


def _half(length: int) -> tuple[int, int]:
    """Returns the margins of a rectangle that is half as large again to each side."""
    return length // 2, length // 2
