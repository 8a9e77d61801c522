"""Equality and `repr` of dataclasses that hold tensors, where the generated ones raise, or print every number."""

from dataclasses import Field, fields
from typing import Any

import torch
from torch import Tensor


class ByValue:
    """Makes `==` of a dataclass compare tensors by shape, type, device and values, and its `repr` fit on a line.

    NaN equals NaN. Declare the class by `@dataclass(frozen=True, eq=False, repr=False)`. Fields with `compare=False` or
    `repr=False` are left out; all instances of a class have one hash.
    """

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        names = [part.name for part in _fields(self) if part.compare]
        return all(_same(getattr(self, name), getattr(other, name)) for name in names)

    def __hash__(self) -> int:
        return hash(type(self))

    def __repr__(self) -> str:
        parts = [f"{part.name}={summary(getattr(self, part.name))}" for part in _fields(self) if part.repr]
        return f"{type(self).__name__}({', '.join(parts)})"


def summary(value: Any) -> str:
    """Returns a value in a few words: of a tensor its type, shape and device, but for numbers, which are written out.

    >>> summary(torch.zeros(512, 512))
    'float32[512, 512]'
    """
    if isinstance(value, Tensor):
        if value.dim() == 0 and value.device.type == "cpu":
            return f"{value.item():.6g}"
        place = "" if value.device.type == "cpu" else f" on {value.device}"
        return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}{place}"
    if isinstance(value, tuple | list) and len(value) > 4:
        return f"{len(value)} × {summary(value[0])}"
    return repr(value)


def _fields(instance: Any) -> tuple[Field[Any], ...]:
    return fields(instance)


def _same(first: Any, second: Any) -> bool:
    if first is second:
        return True
    if isinstance(first, tuple | list) and isinstance(second, tuple | list):
        return len(first) == len(second) and all(map(_same, first, second))
    if not isinstance(first, Tensor) or not isinstance(second, Tensor):
        return not (isinstance(first, Tensor) or isinstance(second, Tensor)) and bool(first == second)
    if (first.shape, first.dtype, first.device) != (second.shape, second.dtype, second.device):
        return False
    with torch.no_grad():
        return bool(((first == second) | (first.isnan() & second.isnan())).all())
