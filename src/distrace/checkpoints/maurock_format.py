"""The runs of maurock's DeepSDF (github.com/maurock/DeepSDF): `weights.pt`, `results.npy` and `settings.yaml`.

Its `SDFModel` is DeepSDF's network by other names: `net.0` to `net.2`, `skip_layer`, `net.3` and on, `final_layer`. The
code and the point enter again after `skip_layer`; that layer and the last have no weight norm. Nothing in a file is
ever run.
"""

import pickle
import re
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.deepsdf_format import PICKLED, modern_name, read_tensors
from distrace.errors import DoubtfulResult, error_context
from distrace.fields.decoder import NetworkSpecs

WEIGHTS = "weights.pt"
SETTINGS = "settings.yaml"
RESULTS = "results.npy"
LEAST_LAYERS = 8  # with skip connections; below, versions of the code differ in what they compute
CLASSES: dict[tuple[str, str], Any] = {("numpy", "ndarray"): np.ndarray, ("numpy", "dtype"): np.dtype}
CLASSES |= {(f"numpy.{core}.multiarray", make.__name__): make for make in PICKLED for core in ("core", "_core")}


def read_run(folder: Path) -> tuple[NetworkSpecs, Path, dict[str, Tensor], Float[Tensor, "shapes length"] | None]:
    """Returns the architecture, the file of weights, these by our names, and the codes, if the run has any.

    Raises `ValueError`, in one sentence, for a file that is missing or damaged, and for another network.
    """
    path = folder / WEIGHTS
    names, length = _settings(folder / SETTINGS)
    with error_context(f"{path} is not a checkpoint of maurock's DeepSDF", path):
        state = {_our_name(key, names): value.float() for key, value in read_tensors(path).items()}
        width, inputs = state["lin0.parametrizations.weight.original1"].shape
    if inputs != length + 3:
        raise ValueError(
            f"{path} takes {inputs} inputs, but {SETTINGS} has codes of {length}, and points have 3; networks with"
            " positional encoding cannot be read"
        )
    is_fed_again = "skip_layer" in names
    if not is_fed_again:
        state = {key: value for key, value in state.items() if not key.startswith("skip_layer.")}  # held, but not used
    specs = NetworkSpecs(
        dims=(width,) * (len(names) - 1),
        code_length=length,
        latent_in=(4,) if is_fed_again else (),
        norm_layers=tuple(number for number, name in enumerate(names) if name.startswith("net.")),
    )
    return specs, path, state, _codes(folder / RESULTS)


def _our_name(key: str, names: list[str]) -> str:
    """Returns what our decoders call a parameter of one of the layers, or the key of any other."""
    key = modern_name(key)
    layer, _, parameter = key.rpartition(".0.")  # each is the first of two modules, before its ReLU
    return f"lin{names.index(layer)}.{parameter}" if layer in names else key


def _settings(path: Path) -> tuple[list[str], int]:
    """Returns the names of the layers, in the order in which they are evaluated, and the length of a code."""
    if not path.is_file():
        raise ValueError(f"{path} is missing; it says whether the network of {WEIGHTS} has skip connections")
    with error_context(f"{path} does not describe a network of maurock's DeepSDF", path):
        text = path.read_text(encoding="utf-8")
        values = dict(re.findall(r"^(\w+): *(\S+) *$", text, flags=re.MULTILINE))  # as yaml.dump writes flat settings
        layers = int(values["num_layers"])
        length = int(values["latent_size"])
        skips = {"true": True, "false": False}[values["skip_connections"]]
    names = [f"net.{number}" for number in range(layers - 1)] + ["final_layer"]
    if skips and 5 <= layers < LEAST_LAYERS:
        raise ValueError(
            f"{path} has skip connections and {layers} layers; what such a network computes depends on the version of"
            f" its code, so that only {LEAST_LAYERS} layers or more can be read"
        )
    if skips and layers >= LEAST_LAYERS:
        names = [*names[:3], "skip_layer", *names[3:-2], names[-1]]
    return names, length


def _codes(path: Path) -> Float[Tensor, "shapes length"] | None:
    if not path.is_file():
        warnings.warn(f"{path} is missing: the model has a decoder, and no codes", DoubtfulResult, stacklevel=4)
        return None
    with error_context(f"{path} is not a file of results with the key best_latent_codes", path):
        with path.open("rb") as file:
            codes = np.asarray(_read_dict(file)["best_latent_codes"], dtype=np.float32)
    if not codes.size:
        warnings.warn(
            f"{path} has no codes yet: a run writes them at its second best epoch", DoubtfulResult, stacklevel=4
        )
        return None
    return torch.from_numpy(codes)


def _read_dict(file: BinaryIO) -> dict[str, Any]:
    """Returns the dictionary that `numpy.save` pickled, by an unpickler that makes arrays and plain values only."""
    version = np.lib.format.read_magic(file)
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    if version != (1, 0) or shape != () or not dtype.hasobject:
        raise ValueError("it holds no dictionary")
    return _Arrays(file).load().item()


class _Arrays(pickle.Unpickler):
    """Makes arrays, dictionaries, lists and plain values, and nothing that a pickle could run."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in CLASSES:
            raise pickle.UnpicklingError("it holds something else than arrays; nothing in it was run")
        return CLASSES[module, name]
