"""The DeepSDF network: a point and a shape's code to a signed distance (Park et al., CVPR 2019, section 4)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import weight_norm

from distrace.field import SDF, chunked

CPU_CHUNK = 4096  # a layer's activations then stay in the cache: 20 µs a point, against 45 µs in batches of 250 K
GPU_CHUNK = 1 << 20


@dataclass(frozen=True)
class NetworkSpecs:
    """The architecture, with the keys of `NetworkSpecs` in DeepSDF's `specs.json`."""

    dims: tuple[int, ...] = (512,) * 8
    code_length: int = 256
    latent_in: tuple[int, ...] = (4,)
    norm_layers: tuple[int, ...] = tuple(range(8))
    weight_norm: bool = True
    xyz_in_all: bool = False
    use_tanh: bool = False
    dropout: tuple[int, ...] = ()
    dropout_prob: float = 0.0


class Decoder(nn.Module):
    """f(point; code): ReLU layers `lin0 … linN`, the input fed again at the layers `latent_in`, tanh at the end.

    Raises `ValueError` for layers without room for what is fed again.
    """

    def __init__(self, specs: NetworkSpecs = NetworkSpecs()) -> None:
        super().__init__()
        self.specs = specs
        widths = [specs.code_length + 3, *specs.dims, 1]
        outputs = [self._outputs(widths, layer) for layer in range(self.depth)]
        if specs.code_length < 1 or min(outputs) < 1:
            given = f"a code of {specs.code_length} and layers of {outputs} outputs"
            raise ValueError(f"{given} were asked for, what is fed again set apart; each must be at least 1")
        for layer in range(self.depth):
            linear = nn.Linear(widths[layer], outputs[layer])
            normed = layer in specs.norm_layers
            setattr(self, f"lin{layer}", weight_norm(linear) if normed and specs.weight_norm else linear)
            if normed and not specs.weight_norm:  # the last layer's is never used, but DeepSDF's files hold it
                setattr(self, f"bn{layer}", nn.LayerNorm(linear.out_features))

    @property
    def depth(self) -> int:
        return len(self.specs.dims) + 1

    def _outputs(self, widths: list[int], layer: int) -> int:
        if layer + 1 in self.specs.latent_in:
            return widths[layer + 1] - widths[0]
        joins_points = self.specs.xyz_in_all and layer < self.depth - 1
        return widths[layer + 1] - (3 if joins_points else 0)

    def forward(
        self, points: Float[Tensor, "*batch 3"], code: Float[Tensor, "*#batch length"]
    ) -> Float[Tensor, "*batch"]:
        """Values in (-1, 1). A code with batch axes of size 1 enters the first layer once, not per point."""
        return self._run(self._folded(code), points)

    def field(self, code: Float[Tensor, "length"]) -> SDF:
        """The signed distance field of one shape, the constant code folded into the biases of the layers it enters.

        Raises `ValueError` for a code of another length.
        """
        if code.shape != (self.specs.code_length,):
            takes = [self.specs.code_length]
            raise ValueError(f"a code of shape {list(code.shape)} was given; this decoder takes {takes}")
        layers = self._folded(code)
        size = CPU_CHUNK if code.device.type == "cpu" else GPU_CHUNK
        return chunked(lambda points: self._run(layers, points), size)

    def _folded(self, code: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Each layer's weight without the code's columns, and its bias with what the code adds."""
        layers, length = [], self.specs.code_length
        for layer in range(self.depth):
            linear = getattr(self, f"lin{layer}")
            weight, bias = linear.weight, linear.bias
            if layer == 0 or layer in self.specs.latent_in:
                start = weight.shape[1] - length - 3
                bias = F.linear(code, weight[:, start : start + length], bias)
                weight = torch.cat([weight[:, :start], weight[:, start + length :]], dim=1)
            layers.append((weight, bias))
        return layers

    def _run(self, layers: list[tuple[Tensor, Tensor]], points: Tensor) -> Tensor:
        x = points
        for layer, (weight, bias) in enumerate(layers):
            if layer and (layer in self.specs.latent_in or self.specs.xyz_in_all):
                x = torch.cat([x, points], dim=-1)
            x = F.linear(x, weight, bias) if bias.dim() == 1 else F.linear(x, weight) + bias
            if layer < self.depth - 1:
                x = self._activated(x, layer)
        x = x[..., 0]
        return torch.tanh(torch.tanh(x) if self.specs.use_tanh else x)

    def _activated(self, x: Tensor, layer: int) -> Tensor:
        norm = getattr(self, f"bn{layer}", None)
        x = F.relu(x if norm is None else norm(x))
        if layer in self.specs.dropout:
            x = F.dropout(x, self.specs.dropout_prob, self.training)
        return x
