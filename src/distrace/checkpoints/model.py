"""Models on disk: DeepSDF's experiment folders, in every dialect that writers of them have used, and the bundled ones.

A folder holds `specs.json` and either `model.safetensors` (ours) or `ModelParameters/NAME.pth` and
`LatentCodes/NAME.pth` (DeepSDF's). Nothing in a file is ever run.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import overload

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.deepsdf_format import read_weights, write_weights
from distrace.equality import ByValue, summary
from distrace.errors import error_context
from distrace.fields.base import SDF
from distrace.fields.batch import BatchField
from distrace.fields.decoder import Decoder, NetworkSpecs, ShapeField
from distrace.files import save_json, save_tensors

BUNDLED = Path(__file__).parents[1] / "models"
VARIANT = "~"  # separates a shape's name from that of its mirrored or warped variant


@dataclass(frozen=True, eq=False, repr=False)
class Model(ByValue):
    """A trained decoder, and the codes [shapes, length] of the shapes that it was trained on.

    `load_model` returns one. Weights are frozen; `model.decoder.requires_grad_()` unfreezes them.
    """

    name: str
    decoder: Decoder
    codes: Float[Tensor, "shapes length"]
    shapes: tuple[str, ...]

    @overload
    def field(self, code: int) -> ShapeField: ...

    @overload
    def field(self, code: Float[Tensor | np.ndarray, "*shapes length"]) -> ShapeField | BatchField: ...

    def field(self, code: int | Float[Tensor | np.ndarray, "*shapes length"]) -> SDF | BatchField:
        """Returns the signed distance field of a training code, of any code, or of B shapes from codes [B, length].

        Raises `ValueError` for a number or a length that the model has not.

        >>> model = load_model("sofas")
        >>> model.field(0)(torch.zeros(5, 3)).shape
        torch.Size([5])
        """
        if isinstance(code, Tensor | np.ndarray):
            return self.decoder.field(code)
        return self.decoder.field(self.code_of(code))

    def __repr__(self) -> str:
        codes = summary(self.codes)
        return f"Model({self.name!r}, {len(self.shapes)} shapes, codes={codes}, {self.decoder.specs.size})"

    def _repr_html_(self) -> str:
        """Returns what Jupyter shows."""
        from distrace import notebook

        facts = {"network": self.decoder.specs.size, "shapes": len(self.shapes), "named": self.shapes}
        return notebook.table(self.name, facts)

    def code_of(self, shape: str | int) -> Float[Tensor, "length"]:
        """Returns a training shape's code, by name or number. Raises `ValueError` for one that the model has not."""
        if isinstance(shape, int):
            if not 0 <= shape < len(self.codes):
                raise ValueError(f"code {shape} was given; {self.name} has {len(self.codes)}, counted from 0")
            return self.codes[shape]
        if shape not in self.shapes:
            close = get_close_matches(shape, self.shapes, cutoff=0.4)
            proposal = f"did you mean {' or '.join(close)}?" if close else "see `model.shapes`"
            raise ValueError(f"{self.name} has no shape {shape!r}; {proposal}")
        return self.codes[self.shapes.index(shape)]

    def codes_of(self, shapes: Sequence[str]) -> Float[Tensor, "n length"]:
        """Returns codes by name: of an unknown variant its original's, of other unknown shapes the mean code."""
        code_of = dict(zip(self.shapes, self.codes, strict=True))
        mean = self.codes.sum(0) / max(len(self.codes), 1)
        return torch.stack([code_of.get(shape, code_of.get(original(shape), mean)) for shape in shapes])

    def to(self, device: torch.device | str) -> "Model":
        return Model(self.name, self.decoder.to(device), self.codes.to(device), self.shapes)


def original(shape: str) -> str:
    """Returns the name of the shape that a variant was made from; of other shapes their own."""
    return shape.split(VARIANT)[0]


def bundled_models() -> list[str]:
    """Returns the names of the bundled models."""
    return sorted(path.parent.name for path in BUNDLED.glob("*/specs.json"))


def model_folder(name: str | Path) -> Path:
    """Returns the folder of a bundled model or of any other. Raises `ValueError` where there is none."""
    folder = BUNDLED / name if str(name) in bundled_models() else Path(name)
    if not folder.is_dir():
        raise ValueError(f"{name} is neither a folder nor a bundled model ({', '.join(bundled_models())})")
    return folder


def load_model(name: str | Path) -> Model:
    """Loads a bundled model by name, or any DeepSDF experiment folder.

    Raises `ValueError`, in one sentence, for whatever is missing, of another architecture, damaged or not finite.

    >>> load_model("sofas")
    Model('sofas', 657 shapes, codes=float32[657, 256], 8 × 512)
    """
    folder = model_folder(name)
    specs, shapes = _read_specs(folder)
    ours = folder / "model.safetensors"
    source, state, codes = _read_safetensors(ours) if ours.exists() else read_weights(folder)
    with error_context(f"{folder / 'specs.json'} describes a network that cannot be"), torch.device("meta"):
        decoder = Decoder(specs)  # on meta: the sizes are only believed once the file has weights of them
    decoder = _filled(decoder, state, source)
    if codes is None:
        codes = torch.empty(0, specs.code_length)
    else:
        _check_codes(codes, specs, folder)
    names = shapes if len(shapes) == len(codes) else tuple(str(number) for number in range(len(codes)))
    return Model(folder.name, decoder.eval().requires_grad_(False), codes, names)


def save_model(folder: str | Path, model: Model, dtype: torch.dtype = torch.float16) -> None:
    """Writes a model into a folder, in distrace's own, smaller form: weight norm multiplied out, in half precision.

    `load_model(folder)` reads it.
    """
    folder = Path(folder)
    specs = model.decoder.specs
    plain = replace(specs, norm_layers=(), weight_norm=False) if specs.weight_norm else specs
    tensors = {key: value for key, value in model.decoder.state_dict().items() if "parametrizations" not in key}
    tensors |= {"codes": model.codes}
    for layer in range(model.decoder.depth):
        tensors[f"lin{layer}.weight"] = getattr(model.decoder, f"lin{layer}").weight
    _write_specs(folder, plain, model.shapes)
    save_tensors(folder / "model.safetensors", tensors, dtype)


def save_experiment(folder: str | Path, decoder: Decoder, codes: Tensor, shapes: tuple[str, ...]) -> None:
    """Writes DeepSDF's own layout, with the key names that its original code reads."""
    folder = Path(folder)
    _write_specs(folder, decoder.specs, shapes)
    write_weights(folder, decoder, codes)


def _write_specs(folder: Path, specs: NetworkSpecs, shapes: tuple[str, ...]) -> None:
    network = asdict(specs)
    length = network.pop("code_length")
    content = {"NetworkArch": "deep_sdf_decoder", "NetworkSpecs": network, "CodeLength": length, "Shapes": shapes}
    save_json(folder / "specs.json", content)


def _read_specs(folder: Path) -> tuple[NetworkSpecs, tuple[str, ...]]:
    path = folder / "specs.json"
    if not path.is_file():
        raise ValueError(
            f"{folder} is not a DeepSDF experiment: it has no specs.json, which names the network's layers"
        )
    with error_context(f"{path} is not a DeepSDF specification", path):
        content = json.loads(path.read_text(encoding="utf-8-sig"))
        _check_architecture(content)
        network = content["NetworkSpecs"]
        specs = NetworkSpecs(
            dims=tuple(int(width) for width in network["dims"]),
            code_length=int(content["CodeLength"]),
            latent_in=_layers(network, "latent_in"),
            norm_layers=_layers(network, "norm_layers"),
            weight_norm=bool(network.get("weight_norm", False)),
            xyz_in_all=bool(network.get("xyz_in_all", False)),
            use_tanh=bool(network.get("use_tanh", False)),
            dropout=_layers(network, "dropout"),
            dropout_prob=float(network.get("dropout_prob") or 0.0),
        )
        shapes = tuple(str(shape) for shape in content.get("Shapes") or ())
    return specs, shapes


def _check_architecture(content: dict) -> None:
    architecture = content.get("NetworkArch") or "deep_sdf_decoder"
    dimension = content["NetworkSpecs"].get("geom_dimension") or 3
    if architecture != "deep_sdf_decoder" or dimension != 3:
        raise ValueError(f"{architecture} of {dimension}-D points; only deep_sdf_decoder of 3-D points can be read")


def _layers(network: dict, key: str) -> tuple[int, ...]:
    return tuple(int(layer) for layer in network.get(key) or ())


def _read_safetensors(path: Path) -> tuple[Path, dict[str, Tensor], Tensor]:
    with error_context(f"{path} is not a safetensors file of a model", path):
        tensors = {key: tensor.float() for key, tensor in safetensors.torch.load_file(path).items()}
        codes = tensors.pop("codes")
    return path, tensors, codes


def _check_codes(codes: Tensor, specs: NetworkSpecs, folder: Path) -> None:
    if codes.dim() != 2 or codes.shape[1] != specs.code_length or not len(codes):
        raise ValueError(
            f"{folder} has codes of shape {list(codes.shape)}, but specs.json asks for [n, {specs.code_length}]"
        )
    if not codes.isfinite().all():
        raise ValueError(f"{folder} has latent codes that are not finite; the training that wrote them has diverged")


def _filled(decoder: Decoder, state: dict[str, Tensor], source: Path) -> Decoder:
    """Returns the decoder with the weights, whose names, shapes and values are checked."""
    expected = decoder.state_dict()
    for key in sorted(expected.keys() | state.keys()):
        if key not in state:
            raise ValueError(f"{source} lacks {key}, which specs.json calls for")
        if key not in expected:
            raise ValueError(f"{source} has {key}, for which specs.json has no place")
        if state[key].shape != expected[key].shape:
            shapes = f"has shape {list(state[key].shape)}, but specs.json asks for {list(expected[key].shape)}"
            raise ValueError(f"{source}: {key} {shapes}")
        if state[key].layout != torch.strided:
            raise ValueError(f"{source}: {key} is a {state[key].layout} tensor; weights are dense")
        if not state[key].isfinite().all():
            raise ValueError(f"{source}: {key} has values that are not finite; the training that wrote it has diverged")
    decoder.load_state_dict(state, assign=True)
    for layer in range(decoder.depth):
        if not getattr(decoder, f"lin{layer}").weight.isfinite().all():  # weight norm divides by a norm
            raise ValueError(f"{source}: the weights of lin{layer} are not finite: its weight norm has a row of zeros")
    return decoder
