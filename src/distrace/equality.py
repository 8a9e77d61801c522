"""Equality of dataclasses that hold tensors: by value, where the generated `==` raises on a tensor's truth value."""

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor


class ByValue:
    """Makes `==` of a dataclass compare tensors by shape, type, device and values. NaN equals NaN.

    Declare the class by `@dataclass(frozen=True, eq=False)`. Equal values have equal hashes, which only know the
    tensors' shapes.
    """

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(_same(mine, theirs) for mine, theirs in zip(_parts(self), _parts(other), strict=True))

    def __hash__(self) -> int:
        known = (part.shape if isinstance(part, Tensor) else part for part in _parts(self))
        return hash((type(self), *known))


def _parts(instance: Any) -> list[Any]:
    return [getattr(instance, field.name) for field in fields(instance)]


def _same(first: Any, second: Any) -> bool:
    if not (isinstance(first, Tensor) and isinstance(second, Tensor)):
        return not isinstance(first, Tensor) and not isinstance(second, Tensor) and bool(first == second)
    if first is second:
        return True
    if (first.shape, first.dtype, first.device) != (second.shape, second.dtype, second.device):
        return False
    with torch.no_grad():
        return bool(((first == second) | (first.isnan() & second.isnan())).all())
