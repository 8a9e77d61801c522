"""Codes as a user names them: a number, a shape's name, or a file."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.model import Model, bundled_models
from distrace.errors import error_context
from distrace.files import atomic_write, save_json
from distrace.pose import Similarity


def named_code(model: Model, given: str) -> Float[Tensor, "length"]:
    """Returns a code by the number or the name of its training shape, or from a `code.npy` that a command wrote.

    Raises `ValueError`, in one sentence, for anything else.
    """
    if given.isdecimal():
        return model.code_of(int(given))
    if not given.endswith(".npy"):
        with error_context(f"{given} is neither the number nor the name of a training shape, nor a code.npy"):
            return model.code_of(given)
    return read_code(Path(given), model.codes, model.name)


def read_code(path: Path, codes: Float[Tensor, "n length"], model: str) -> Float[Tensor, "length"]:
    """Returns a code from a file that a command wrote, as long as a model's `codes` and on their device.

    Raises `ValueError`, in one sentence, for anything else.
    """
    with error_context(f"{path} is no code that a command wrote", path):
        code = torch.from_numpy(np.load(path, allow_pickle=False)).to(codes)
        if code.shape != codes.shape[1:]:
            length = codes.shape[1]
            raise ValueError(f"it has the shape {list(code.shape)}, and codes of {model} have {length} values")
        if not code.isfinite().all():
            raise ValueError("it has values that are not finite")
    return code


def code_title(model: Model, given: str) -> str:
    """Returns what to call a code: the model, and the shape or the file."""
    shape = model.shapes[int(given)] if given.isdecimal() else given
    return f"{model.name}, {shape}"


def model_source(name: str) -> str:
    """Returns where a model can be loaded from again: its bundled name, or its folder from the root."""
    return name if name in bundled_models() else str(Path(name).resolve())


def save_code(folder: Path, code: Float[Tensor, "length"], place: Similarity | None = None) -> None:
    """Writes a code, and the placement of its shape in the frame of the input where there is one."""
    with atomic_write(folder / "code.npy") as file:
        np.save(file, code.detach().cpu().numpy())
    if place is not None:
        save_json(folder / "placement.json", {"T_input_object": place.T_world_object.tolist()})
