"""The weights and codes in DeepSDF's experiment folders, in every dialect that writers of them have used.

`ModelParameters/NAME.pth` and `LatentCodes/NAME.pth`: Park et al., *DeepSDF*, CVPR 2019. Nothing in a file is ever run.
"""

import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.errors import DoubtfulResult, error_context
from distrace.fields.decoder import Decoder
from distrace.files import atomic_write

LATEST = "latest.pth"
BESIDE = "homogen_network."  # a head of DeepSDFStruct's decoders that does not enter the distance
SPLINES = "latent_fields_state_dict"
PICKLED: tuple[Any, Any] = (np.zeros(1).__reduce__()[0], np.float64(0).__reduce__()[0])  # of an array and a scalar
NUMPY = [np.ndarray, np.dtype, *{type(np.dtype(kind)) for kind in "?bBhHiIlLqQefd"}]
NUMPY += [(make, f"numpy.{core}.multiarray.{make.__name__}") for make in PICKLED for core in ("core", "_core")]


def write_weights(folder: Path, decoder: Decoder, codes: Float[Tensor, "shapes length"]) -> None:
    """With the key names that DeepSDF's original code reads."""
    state = {_classic(key): value.detach().cpu() for key, value in decoder.state_dict().items()}
    with atomic_write(folder / "ModelParameters" / LATEST) as file:
        torch.save({"epoch": 0, "model_state_dict": state}, file)
    with atomic_write(folder / "LatentCodes" / LATEST) as file:
        torch.save({"epoch": 0, "latent_codes": {"weight": codes.detach().cpu()}}, file)


def read_weights(folder: Path) -> tuple[Path, dict[str, Tensor], Float[Tensor, "shapes length"] | None]:
    """The file that was read, a decoder's weights by our names, and the codes, if there is a file of them.

    Raises `ValueError`, in one sentence, for weights that are missing, and for a file that holds something else.
    """
    weights = _checkpoint(folder / "ModelParameters")
    with error_context(f"{weights} is not a DeepSDF checkpoint with the key model_state_dict", weights):
        stored = read_tensors(weights)["model_state_dict"]
        state = {modern_name(key): _tensor(value).float() for key, value in stored.items() if BESIDE not in key}
    latent = folder / "LatentCodes" / weights.name
    if not latent.is_file():
        warnings.warn(f"{latent} is missing: the model has a decoder, and no codes", DoubtfulResult, stacklevel=3)
        return weights, state, None
    with error_context(f"{latent} is not a file of DeepSDF codes with the key latent_codes", latent):
        codes = _codes(read_tensors(latent))
    return weights, state, codes


def read_tensors(path: Path) -> dict:
    """Returns what `torch.save` wrote, if it is tensors, and nothing that a pickle could run."""
    try:
        with warnings.catch_warnings(), torch.serialization.safe_globals(NUMPY):
            warnings.simplefilter("ignore")
            return torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, KeyError):
        raise ValueError("it holds something else than tensors; nothing in it was run") from None


def modern_name(key: str) -> str:
    """Returns the name that our decoders have for a parameter."""
    key = re.sub(r"\b(module|_orig_mod)\.", "", key)  # DataParallel and torch.compile wrap modules at any depth
    key = re.sub(r"weight_g$", "parametrizations.weight.original0", key)
    return re.sub(r"weight_v$", "parametrizations.weight.original1", key)


def _checkpoint(folder: Path) -> Path:
    """`latest.pth`, or else the one of the most epochs."""
    found = sorted(folder.glob("*.pth"), key=lambda path: int(path.stem) if path.stem.isdecimal() else -1)
    if not found:
        raise ValueError(f"{folder} holds no checkpoint; {LATEST} or one named by its epoch (2000.pth) is looked for")
    return folder / LATEST if (folder / LATEST) in found else found[-1]


def _codes(content: dict) -> Float[Tensor, "shapes length"]:
    """A code per shape; or, where codes vary over space (DeepSDFStruct's latent fields), all their control points."""
    if SPLINES in content:  # their `latent_codes` are zeros
        return torch.cat([value.float() for key, value in content[SPLINES].items() if key.endswith("control_points")])
    stored = content["latent_codes"]
    if isinstance(stored, dict):
        stored = stored["weight"] if "weight" in stored else list(stored.values())
    if isinstance(stored, list):
        stored = torch.stack([_tensor(code).reshape(-1) for code in stored])
    return _tensor(stored).detach().float().reshape(len(stored), -1)


def _tensor(value: Tensor | np.ndarray) -> Tensor:
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def _classic(key: str) -> str:
    key = key.replace("parametrizations.weight.original0", "weight_g")
    return "module." + key.replace("parametrizations.weight.original1", "weight_v")
