"""Derivatives of images with respect to one number h, pixel by pixel: by autograd and by finite differences."""

from collections.abc import Callable

import torch
from torch import Tensor

Images = dict[str, Tensor]


def image_derivatives(images: Callable[[Tensor], Images], like: Tensor) -> Images:
    """Returns d images / dh at h = 0 for every pixel, by autograd; zero for an image that does not depend on h.

    `like` gives dtype and device of h. Two reverse passes make a forward pass: the product with a cotangent u is
    linear in u. Its derivative by u is the derivative by h (Townsend, *A new trick for calculating Jacobian vector
    products*, 2017).
    """
    h = like.new_zeros(()).requires_grad_()
    values = images(h)
    zeros = {name: torch.zeros_like(value) for name, value in values.items()}
    attached = {name: value for name, value in values.items() if value.requires_grad}
    if not attached:
        return zeros
    cotangents = [torch.zeros_like(value).requires_grad_() for value in attached.values()]
    (product,) = torch.autograd.grad(list(attached.values()), h, cotangents, create_graph=True, allow_unused=True)
    if product is None or not product.requires_grad:
        return zeros
    by_cotangent = torch.autograd.grad(product, cotangents, allow_unused=True)
    return zeros | {name: slope for name, slope in zip(attached, by_cotangent, strict=True) if slope is not None}


@torch.no_grad()
def differences(images: Callable[[Tensor], Images], values: Images, step: float, like: Tensor) -> tuple[Images, Images]:
    """Returns central differences over ± `step`, and the disagreement of the one-sided ones, large at a kink.

    `values` are the images at h = 0.
    """
    before = images(like.new_tensor(-step))
    after = images(like.new_tensor(step))
    central = {name: (after[name] - before[name]) / (2 * step) for name in values}
    kink = {name: (after[name] - 2 * values[name] + before[name]) / step for name in values}
    return central, kink
