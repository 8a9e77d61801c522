"""An accelerator that is only pretended: its tensors say that they are on "meta", have values, and refuse to be mixed
with those of the CPU, as CUDA's do. So what forgets to move something is found on any machine."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("meta")
ATEN = torch.ops.aten
TAKE_CPU_INDICES = {ATEN.index.Tensor, ATEN.index_put.default, ATEN.index_put_.default, ATEN._index_put_impl_.default}
MOVE = {ATEN.copy_.default, ATEN._to_copy.default}
MIXED = "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!"


class There(Tensor):
    """A tensor of the pretended device; `inner` has its values."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "There":
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made = Tensor._make_wrapper_subclass(cls, inner.shape, device=DEVICE, **layout)
        made.inner = inner
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return done(func, args, kwargs or {})

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first")

    __array__ = numpy

    def tolist(self) -> Any:
        return self.inner.tolist()

    def new_tensor(self, data: Any, **options: Any) -> Tensor:
        return there(torch.tensor(data, dtype=options.get("dtype", self.dtype)))


class _Pretending(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return done(func, args, kwargs or {})


def there(tensor: Tensor) -> Tensor:
    return done(ATEN._to_copy.default, (tensor,), {"device": DEVICE})


def done(func: Any, args: tuple, kwargs: dict) -> Any:
    """What an operation gives, on the device where it would be; raises `RuntimeError` where it mixes devices."""
    values: list[Tensor] = []
    inner_args, inner_kwargs = _mapped(partial(_noted, values), (args, kwargs))
    wanted = kwargs.get("device")
    ours = any(isinstance(each, There) for each in values)
    if func not in MOVE and ours:
        _refuse_mixed(func, args, values)
    if wanted is not None:
        inner_kwargs["device"] = torch.device("cpu")
    result = func(*inner_args, **inner_kwargs)
    if func is ATEN._local_scalar_dense.default:
        return result
    if func is ATEN.copy_.default or func._schema.name.endswith("_"):
        return args[0]
    if torch.device(wanted) != DEVICE if wanted is not None else not ours:
        return result
    return _mapped(There, result)


def _noted(values: list[Tensor], tensor: Tensor) -> Tensor:
    values.append(tensor)
    return tensor.inner if isinstance(tensor, There) else tensor


def _mapped(change: Callable[[Tensor], Tensor], given: Any) -> Any:
    """With all tensors in it changed, also those in lists, tuples and dicts."""
    if isinstance(given, Tensor):
        return change(given)
    if isinstance(given, dict):
        return {name: _mapped(change, each) for name, each in given.items()}
    return type(given)([_mapped(change, each) for each in given]) if type(given) in (list, tuple) else given


def _refuse_mixed(func: Any, args: tuple, values: list[Tensor]) -> None:
    """Numbers may be anywhere, and so may indices of what is on the device."""
    if func in TAKE_CPU_INDICES and isinstance(args[0], There):
        values = [each for each in args[2:3] if isinstance(each, Tensor)]
    if any(each.dim() and not isinstance(each, There) for each in values):
        raise RuntimeError(f"{MIXED} ({func})")


@contextmanager
def pretended(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Within, `device="meta"` is the pretended one, also for what makes tensors from Python's numbers."""
    plain_autocast = torch.autocast
    for name in ("tensor", "as_tensor"):
        monkeypatch.setattr(torch, name, _making(getattr(torch, name)))
    monkeypatch.setattr(torch, "autocast", lambda kind, *a, **k: _autocast(plain_autocast, kind, *a, **k))
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda kind="cpu": False)
    monkeypatch.setattr(Tensor, "__matmul__", _product)
    with _Pretending():
        yield


def _product(one: Tensor, other: Tensor) -> Tensor:
    """A vector with a matrix: PyTorch makes it a row, and takes that axis away in place, which nothing here can."""
    return torch.matmul(one[None], other)[0] if (one.dim(), other.dim()) == (1, 2) else torch.matmul(one, other)


def _making(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def made(data: Any, *, dtype: torch.dtype | None = None, device: Any = None, **options: Any) -> Tensor:
        if isinstance(data, There):
            return data.to(dtype=dtype or data.dtype, device=device or data.device)
        plain = make(data, dtype=dtype, **options)
        return there(plain) if device is not None and torch.device(device) == DEVICE else plain

    return made


def _autocast(autocast: Any, kind: str, *arguments: Any, **options: Any) -> Any:
    return nullcontext() if kind == DEVICE.type else autocast(kind, *arguments, **options)
