"""Models on disk: DeepSDF's experiment folders, in every dialect that writers of them have used, and the bundled ones.

A folder holds `specs.json`, or `config.json`, and either `model.safetensors` (ours) or `ModelParameters/NAME.pth` and
`LatentCodes/NAME.pth` (DeepSDF's); or it is a run of maurock's DeepSDF. Nothing in a file is ever run.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import overload

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints import maurock_format
from distrace.checkpoints.deepsdf_format import read_weights, write_weights
from distrace.checkpoints.specs_file import SPECS, read_specs, specs_path, write_specs
from distrace.equality import ByValue, summary
from distrace.errors import error_context
from distrace.fields.base import SDF
from distrace.fields.batch import BatchField
from distrace.fields.decoder import Decoder, ShapeField
from distrace.files import save_tensors

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
    folder: Path | None = dataclasses.field(default=None, compare=False, repr=False)  # that it was loaded from

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
        return replace(self, decoder=self.decoder.to(device), codes=self.codes.to(device))

    @staticmethod
    def from_pretrained(
        name: str | Path, *, download: bool = False, revision: str | None = None, cache: Path | None = None
    ) -> "Model":
        """Loads a folder or a bundled model as `load_model` does, or a repository `owner/name` of the Hugging Face Hub.

        A repository is read from the local cache (`cache`, or the Hub's own); only `download=True` uses the network.
        Only safetensors and JSON are read. Raises `ValueError`, in one sentence, for anything that cannot be loaded.

        >>> Model.from_pretrained("sofas").name
        'sofas'
        """
        from distrace.checkpoints import hub

        return hub.from_pretrained(name, download, revision, cache)

    def save_pretrained(self, folder: str | Path, *, licence: str = "unknown", trained_on: str = "") -> None:
        """Writes `config.json`, `model.safetensors` (in half precision) and a model card, `README.md`.

        The card says what the model was trained on: `trained_on`, or what the folder that it was loaded from says.
        Raises `ValueError` for a folder that holds a DeepSDF experiment, or a licence that is no identifier.
        """
        from distrace.checkpoints import hub

        hub.save_pretrained(self, Path(folder), licence, trained_on)

    def push_to_hub(
        self, repository: str, *, licence: str = "unknown", trained_on: str = "", private: bool = False
    ) -> str:
        """Uploads what `save_pretrained` writes to `owner/name` on the Hugging Face Hub; returns the commit's address.

        The repository is made where there is none. `hf auth login`, or HF_TOKEN, says who you are.
        """
        from distrace.checkpoints import hub

        return hub.push_to_hub(self, repository, licence, trained_on, private)


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
    """Loads a bundled model by name, or a folder: of a DeepSDF experiment, from the Hugging Face Hub, or of a run of
    maurock's DeepSDF.

    Raises `ValueError`, in one sentence, for whatever is missing, of another architecture, damaged or not finite.

    >>> load_model("sofas")
    Model('sofas', 657 shapes, codes=float32[657, 256], 8 × 512)
    """
    folder = model_folder(name)
    described = specs_path(folder)
    if (folder / maurock_format.WEIGHTS).is_file() and not described.is_file():
        described = folder / maurock_format.SETTINGS
        specs, source, state, codes = maurock_format.read_run(folder)
        shapes: tuple[str, ...] = ()
    else:
        specs, shapes = read_specs(folder)
        ours = folder / "model.safetensors"
        source, state, codes = _read_safetensors(ours) if ours.exists() else read_weights(folder)
    with error_context(f"{described} describes a network that cannot be"), torch.device("meta"):
        decoder = Decoder(specs)  # on meta: the sizes are only believed once the file has weights of them
    decoder = _filled(decoder, state, source, described.name)
    if codes is None:
        codes = torch.empty(0, specs.code_length)
    else:
        _check_codes(codes, specs.code_length, folder, described.name)
    names = shapes if len(shapes) == len(codes) else tuple(str(number) for number in range(len(codes)))
    return Model(folder.name, decoder.eval().requires_grad_(False), codes, names, folder)


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
    write_specs(folder / SPECS, plain, model.shapes)
    save_tensors(folder / "model.safetensors", tensors, dtype)


def save_experiment(folder: str | Path, decoder: Decoder, codes: Tensor, shapes: tuple[str, ...]) -> None:
    """Writes DeepSDF's own layout, with the key names that its original code reads."""
    folder = Path(folder)
    write_specs(folder / SPECS, decoder.specs, shapes)
    write_weights(folder, decoder, codes)


def _read_safetensors(path: Path) -> tuple[Path, dict[str, Tensor], Tensor]:
    with error_context(f"{path} is not a safetensors file of a model", path):
        tensors = {key: tensor.float() for key, tensor in safetensors.torch.load_file(path).items()}
        codes = tensors.pop("codes")
    return path, tensors, codes


def _check_codes(codes: Tensor, length: int, folder: Path, described: str) -> None:
    if codes.dim() != 2 or codes.shape[1] != length or not len(codes):
        raise ValueError(f"{folder} has codes of shape {list(codes.shape)}, but {described} asks for [n, {length}]")
    if not codes.isfinite().all():
        raise ValueError(f"{folder} has latent codes that are not finite; the training that wrote them has diverged")


def _filled(decoder: Decoder, state: dict[str, Tensor], source: Path, described: str) -> Decoder:
    """Returns the decoder with the weights, whose names, shapes and values are checked.

    `described` is the name of the file that describes the network.
    """
    expected = decoder.state_dict()
    for key in sorted(expected.keys() | state.keys()):
        if key not in state:
            raise ValueError(f"{source} lacks {key}, which {described} calls for")
        if key not in expected:
            raise ValueError(f"{source} has {key}, for which {described} has no place")
        if state[key].shape != expected[key].shape:
            shapes = f"has shape {list(state[key].shape)}, but {described} asks for {list(expected[key].shape)}"
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
