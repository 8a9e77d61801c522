"""The DeepSDF network: a point and a shape's code to a signed distance (Park et al., CVPR 2019, section 4)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import weight_norm

from distrace.equality import summary
from distrace.fields.base import SDF, flattened, in_chunks
from distrace.fields.batch import BatchField
from distrace.fields.products import Layer, Product, evaluate_layers, linear, linear_of_units_and_points
from distrace.fields.pruning import Activity

CHUNK = 1 << 20  # points evaluated at a time without derivatives
RECORDED_CHUNK = 4096  # … and with them on a CPU: a layer's fresh activations then stay in the cache
FAR = 0.1  # the distance at which DeepSDF clamps its samples: decoders are not trained on larger ones


@dataclass(frozen=True)
class NetworkSpecs:
    """A decoder's architecture, with the keys of `NetworkSpecs` in DeepSDF's `specs.json`."""

    dims: tuple[int, ...] = (512,) * 8
    code_length: int = 256
    latent_in: tuple[int, ...] = (4,)
    norm_layers: tuple[int, ...] = tuple(range(8))
    weight_norm: bool = True
    xyz_in_all: bool = False
    use_tanh: bool = False
    dropout: tuple[int, ...] = ()
    dropout_prob: float = 0.0

    @property
    def size(self) -> str:
        """Returns the hidden layers in words: `8 × 512`, or their widths one by one."""
        widths = set(self.dims)
        return f"{len(self.dims)} × {widths.pop()}" if len(widths) == 1 else "-".join(map(str, self.dims))


class Decoder(nn.Module):
    """The DeepSDF network f(point; code): ReLU layers `lin0 … linN`, and tanh at the end.

    The input enters again at the layers `latent_in`. Raises `ValueError` for layers without room for it.

    >>> decoder = Decoder(NetworkSpecs(dims=(32, 32), code_length=4, latent_in=(), norm_layers=()))
    >>> decoder(torch.zeros(5, 3), torch.zeros(4)).shape
    torch.Size([5])
    """

    def __init__(self, specs: NetworkSpecs = NetworkSpecs()) -> None:
        super().__init__()
        self.specs = specs
        widths = [specs.code_length + 3, *specs.dims, 1]
        outputs = [self._outputs(widths, layer) for layer in range(self.depth)]
        if specs.code_length < 1 or min(outputs) < 1:
            given = f"a code of {specs.code_length} and layers of {outputs} outputs"
            raise ValueError(f"{given} were given, without the inputs that are fed again; each must be at least 1")
        for layer in range(self.depth):
            linear = nn.Linear(widths[layer], outputs[layer])
            normed = layer in specs.norm_layers
            setattr(self, f"lin{layer}", weight_norm(linear) if normed and specs.weight_norm else linear)
            if normed and not specs.weight_norm:  # the last layer's is never used, but DeepSDF's files hold it
                setattr(self, f"bn{layer}", nn.LayerNorm(linear.out_features))

    @property
    def depth(self) -> int:
        return len(self.specs.dims) + 1

    @property
    def has_layer_norms(self) -> bool:
        return bool(self.specs.norm_layers) and not self.specs.weight_norm

    def is_fed(self, layer: int) -> bool:
        """Returns whether points enter a layer, with or without the code."""
        return layer == 0 or layer in self.specs.latent_in or self.specs.xyz_in_all

    def _outputs(self, widths: list[int], layer: int) -> int:
        if layer + 1 in self.specs.latent_in:
            return widths[layer + 1] - widths[0]
        joins_points = self.specs.xyz_in_all and layer < self.depth - 1
        return widths[layer + 1] - (3 if joins_points else 0)

    def forward(
        self, points: Float[Tensor, "*batch 3"], code: Float[Tensor, "*#batch length"]
    ) -> Float[Tensor, "*batch"]:
        """Returns values in (-1, 1). A code with batch axes of size 1 enters the first layer once, not per point.

        Under autocast points and code keep their precision: in bfloat16 a point at 0.8 would be off by up to 0.002.
        """
        return self._run(self.folded(code), points)

    def field(self, code: Float[Tensor | np.ndarray, "*shapes length"]) -> "ShapeField | BatchField":
        """Returns the signed distance field of one shape or, from codes [B, length], the field of B shapes.

        The code is folded into the biases of the layers that it enters, and keeps its gradient. The field has the
        decoder's precision. Raises `ValueError` for a code of another length.
        """
        code = self.checked(code)
        return self.fields(code) if code.dim() == 2 else self._single(code)

    def fields(self, codes: Float[Tensor | np.ndarray, "shapes length"]) -> BatchField:
        """Returns the field of several shapes."""
        codes = self.checked(codes)
        return BatchField(codes, Evaluation(self, self.folded(codes)), self._single)

    def _single(self, code: Tensor) -> "ShapeField":
        return ShapeField(self, self.folded(code), code)

    def checked(self, code: Float[Tensor | np.ndarray, "*shapes length"]) -> Float[Tensor, "*shapes length"]:
        """Returns codes in the decoder's precision and on its device. Raises `ValueError` for another length."""
        code = torch.as_tensor(code).to(next(self.parameters()))
        length = self.specs.code_length
        if code.dim() not in (1, 2) or code.shape[-1] != length:
            takes = f"[shapes, {length}]" if code.dim() == 2 else [length]
            raise ValueError(f"a code of shape {list(code.shape)} was given; this decoder takes {takes}")
        return code

    def folded(self, code: Float[Tensor, "*batch length"]) -> list[Layer]:
        """Returns each layer's weight without the code's columns, and its bias with the code's part [*batch, outputs].

        Both keep their precision under autocast.
        """
        layers: list[Layer] = []
        length = self.specs.code_length
        for layer in range(self.depth):
            linear: nn.Linear = getattr(self, f"lin{layer}")
            weight = linear.weight
            bias = linear.bias
            if layer == 0 or layer in self.specs.latent_in:
                start = weight.shape[1] - length - 3
                with torch.autocast(code.device.type, enabled=False):
                    bias = F.linear(code, weight[:, start : start + length], bias)
                weight = torch.cat([weight[:, :start], weight[:, start + length :]], dim=1)
            layers.append((weight, bias))
        return layers

    def _run(self, layers: list[Layer], points: Tensor, watch: Callable[[int, Tensor], None] | None = None) -> Tensor:
        x = points[..., :0]
        for layer, (weight, bias) in enumerate(layers):
            x = linear_of_units_and_points(x, points, weight, bias) if self.is_fed(layer) else linear(x, weight, bias)
            if layer < self.depth - 1:
                if watch:
                    watch(layer, x)
                x = self._activated(x, layer)
        return self.output(x[..., 0])

    def output(self, x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Returns the values of the last layer's outputs: their tanh."""
        return torch.tanh(torch.tanh(x) if self.specs.use_tanh else x)

    def _activated(self, x: Tensor, layer: int) -> Tensor:
        norm = getattr(self, f"bn{layer}", None)
        x = F.relu(x if norm is None else norm(x), inplace=not torch.is_grad_enabled())
        if layer in self.specs.dropout:
            x = F.dropout(x, self.specs.dropout_prob, self.training)
        return x


class Evaluation:
    """Evaluates layers that one code is folded into, or several: then `shape` numbers each point's shape."""

    def __init__(self, decoder: Decoder, layers: list[Layer]) -> None:
        self.decoder = decoder
        self.layers = layers
        self.products = [Product.of(layer, decoder.is_fed(number)) for number, layer in enumerate(layers)]

    def __call__(self, points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None = None) -> Float[Tensor, "n"]:
        """Returns values at points; they keep their precision under autocast.

        Raises `ValueError` for points of another precision than the decoder's.
        """
        weight = self.layers[0][0]
        if points.dtype != weight.dtype:
            raise ValueError(
                f"points in {points.dtype} were given to a decoder in {weight.dtype}; give a camera in that precision,"
                " or change the decoder's by `.double()` or `.float()`"
            )
        on_cpu = weight.device.type == "cpu"
        quick = on_cpu and not torch.is_grad_enabled() and not self.decoder.has_layer_norms
        quick = quick and not self.decoder.training and not torch._C._are_functorch_transforms_active()
        size = RECORDED_CHUNK if on_cpu and not quick else CHUNK
        rows = (points,) if shape is None else (points, shape)
        with torch.autocast(points.device.type, enabled=False):  # in bfloat16 surfaces would be off by 1e-3
            return in_chunks(self._quick if quick else self._recorded, size, *rows)

    def _quick(self, points: Tensor, shape: Tensor | None = None) -> Tensor:
        return self.decoder.output(evaluate_layers(self.products, points, shape))

    def _recorded(self, points: Tensor, shape: Tensor | None = None) -> Tensor:
        """By operations that autograd and `torch.func` see through."""
        layers = self.layers if shape is None else [(w, b if b.dim() == 1 else b[shape]) for w, b in self.layers]
        return self.decoder._run(layers, points)


class ShapeField:
    """The signed distance field of one shape, as `model.field(code)` returns it: a decoder with the code folded in.

    Call it with points [*batch, 3] for distances [*batch], in the model's units. `code` is None once it is pruned.
    """

    def __init__(self, decoder: Decoder, layers: list[Layer], code: Float[Tensor, "length"] | None = None) -> None:
        self.decoder = decoder
        self.layers = layers
        self.code = code
        self.evaluate = Evaluation(decoder, layers)

    def __repr__(self) -> str:
        return f"ShapeField({self.decoder.specs.size}, code={summary(self.code)})"

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return flattened(self.evaluate, points)

    @torch.no_grad()
    def pruned(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], SDF]:
        """Returns values at points, and the field without the ReLU units that are off at all of them, by a margin.

        Around the points it has the same values to rounding, at half the cost for an 8 × 512 decoder near its surface.
        """
        if not len(points) or self.decoder.has_layer_norms or self.decoder.training:
            return self(points), self  # a layer's norm is over all of its units
        units = Activity(self.layers)
        values = in_chunks(partial(self.decoder._run, self.layers, watch=units.watch), RECORDED_CHUNK, points)
        with torch.enable_grad():  # the pruned field is as differentiable as the whole
            return values, ShapeField(self.decoder, units.pruned())
