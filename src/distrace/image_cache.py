"""Images that are computed on first use, and share one graph."""

from collections.abc import Callable
from functools import wraps
from typing import Any, cast

import torch
from torch import Tensor

Images = dict[tuple[str, bool], Tensor]
"""The images computed so far, by their names and whether they have gradients."""


def cached(compute: Callable[[Any], Tensor]) -> Callable[[Any], Tensor]:
    """Keeps an image in `images` of its owner: once with its gradients, and once without where grad mode is off."""

    @wraps(compute)
    def read(owner: Any) -> Tensor:
        key = (compute.__name__, torch.is_grad_enabled())
        if key not in owner.images:
            image = compute(owner)
            owner.images[key] = cast(Tensor, _Shared.apply(image)) if image.requires_grad else image
        return owner.images[key]

    return read


class _Shared(torch.autograd.Function):
    """The identity, for an image that other images use; it explains why a second backward pass fails."""

    @staticmethod
    def forward(ctx: Any, image: Tensor) -> Tensor:
        ctx.save_for_backward(image.new_empty(0))
        return image.view_as(image)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        try:
            ctx.saved_tensors  # noqa: B018 – PyTorch raises where a backward pass has freed the graph
        except RuntimeError as error:
            raise RuntimeError(
                "the images of one rendering share a graph, which a backward pass has freed; add up the losses and"
                " call backward once, or pass retain_graph=True to every backward but the last"
            ) from error
        return gradient
