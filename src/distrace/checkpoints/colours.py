"""A model's colours on disk: `colours.json` and `colours.safetensors` beside its shapes. Nothing in a file is run."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.codes import read_code
from distrace.checkpoints.model import Model, model_folder
from distrace.errors import error_context
from distrace.fields.colour import Albedo, ColourDecoder, ColourSpecs
from distrace.files import save_json, save_tensors

SPECS = "colours.json"
WEIGHTS = "colours.safetensors"


@dataclass(frozen=True)
class Colours:
    """A colour decoder, and the colour codes [palettes, length] that it was trained with.

    The first codes are those of the shapes' own colours, in the order of `shapes`.
    """

    decoder: ColourDecoder
    codes: Float[Tensor, "palettes length"]
    shapes: tuple[str, ...]

    def to(self, device: torch.device | str) -> "Colours":
        return Colours(self.decoder.to(device), self.codes.to(device), self.shapes)

    def code_of(self, shape: str) -> Float[Tensor, "length"]:
        """Returns the code of a shape's own colours. Raises `ValueError` for a shape without."""
        if shape not in self.shapes:
            raise ValueError(f"{shape} has no colours of its own; {', '.join(self.shapes)} have")
        return self.codes[self.shapes.index(shape)]


def save_colours(folder: Path, colours: Colours) -> None:
    """Writes the colours into a model's folder, in half precision."""
    save_json(folder / SPECS, {"specs": asdict(colours.decoder.specs), "shapes": colours.shapes})
    save_tensors(folder / WEIGHTS, {**colours.decoder.state_dict(), "codes": colours.codes.detach()}, torch.float16)


def load_colours(model: str | Path) -> Colours | None:
    """Loads the colours of a bundled model or a folder; None where it has none.

    Raises `ValueError`, in one sentence, for files that are damaged, or that do not fit each other.
    """
    folder = model_folder(model)
    path = folder / SPECS
    if not path.is_file():
        return None
    with error_context(f"{path} does not describe a colour decoder", path):
        content = json.loads(path.read_text(encoding="utf-8"))
        with torch.device("meta"):  # the sizes are only believed once the file has weights of them
            decoder = ColourDecoder(ColourSpecs(**content["specs"]))
        shapes = tuple(str(shape) for shape in content["shapes"])
    weights = folder / WEIGHTS
    with error_context(f"{weights} does not hold the colour decoder that {SPECS} describes", weights):
        tensors = {key: tensor.float() for key, tensor in safetensors.torch.load_file(weights).items()}
        codes = tensors.pop("codes")
        if any(not tensor.isfinite().all() for tensor in (codes, *tensors.values())):
            raise ValueError("it has values that are not finite")
        decoder.load_state_dict(tensors, assign=True)
        if codes.dim() != 2 or codes.shape[1] != decoder.specs.colour_code or len(codes) < len(shapes):
            raise ValueError(f"its codes have the shape {list(codes.shape)}")
    return Colours(decoder.eval().requires_grad_(False), codes, shapes)


def colours_of(model: Model, name: str | Path) -> Colours:
    """Returns the colours of a model. Raises `ValueError` where there are none, or for other codes."""
    colours = load_colours(name)
    if colours is None:
        raise ValueError(f"{model.name} has no colours; `distrace train MESHES --colour --begin-with {name}` adds some")
    length = model.codes.shape[1]
    if colours.decoder.specs.shape_code != length:
        raise ValueError(
            f"the colours of {model.name} are for codes of {colours.decoder.specs.shape_code}, not {length}"
        )
    return colours.to(model.codes.device)


def named_albedo(model: Model, source: str | Path, shape: str, code: Float[Tensor, "length"], given: str) -> Albedo:
    """Returns the albedo of a code in the colours that a user names.

    `own` are those of the shape, by its number or name; otherwise those of another training shape, or of a `colour.npy`
    that a command wrote. Raises `ValueError`, in one sentence, for anything else.
    """
    with error_context(f"--colour {given} was given"):
        colours = colours_of(model, source)
    if given.endswith(".npy"):
        colour = read_code(Path(given), colours.codes, f"the colours of {model.name}")
    else:
        name = shape if given == "own" else given
        name = model.shapes[int(name)] if name.isdecimal() and int(name) < len(model.shapes) else name
        with error_context(f"--colour {given} was given"):
            colour = colours.code_of(name)
    return colours.decoder.albedo(code, colour)
