"""Derivatives of images with respect to one number, pixel by pixel: by autograd, and by finite differences."""

from collections.abc import Callable

import torch
from torch import Tensor

Images = dict[str, Tensor]


def derivatives(images: Callable[[Tensor], Images], like: Tensor) -> Images:
    """d images / dh at h = 0, of every pixel at once, by autograd; zero where an image does not depend on h.

    A product with a cotangent u is linear in u, and its derivative by u is the derivative by h: reverse mode twice is
    forward mode (Townsend, *A new trick for calculating Jacobian vector products*, 2017).
    """
    h = like.new_zeros(()).requires_grad_()
    values = images(h)
    found = {name: torch.zeros_like(value) for name, value in values.items()}
    attached = {name: value for name, value in values.items() if value.requires_grad}
    if not attached:
        return found
    cotangents = [torch.zeros_like(value).requires_grad_() for value in attached.values()]
    (product,) = torch.autograd.grad(list(attached.values()), h, cotangents, create_graph=True, allow_unused=True)
    if product is None or not product.requires_grad:
        return found
    by_cotangent = torch.autograd.grad(product, cotangents, allow_unused=True)
    return found | {name: slope for name, slope in zip(attached, by_cotangent, strict=True) if slope is not None}


@torch.no_grad()
def differences(images: Callable[[Tensor], Images], here: Images, step: float, like: Tensor) -> tuple[Images, Images]:
    """Central differences of images around `here`, and by how much the one-sided ones disagree: there is a kink."""
    before, after = (images(like.new_tensor(h)) for h in (-step, step))
    central = {name: (after[name] - before[name]) / (2 * step) for name in here}
    bend = {name: (after[name] - 2 * here[name] + before[name]) / step for name in here}
    return central, bend
