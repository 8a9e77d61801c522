"""The file that describes a model's network and names its shapes: `specs.json`, as DeepSDF has it.

A folder from the Hugging Face Hub calls the same file `config.json`.
"""

import json
from dataclasses import asdict
from pathlib import Path

from distrace.errors import error_context
from distrace.fields.decoder import NetworkSpecs
from distrace.files import save_json

SPECS = "specs.json"
CONFIG = "config.json"


def specs_path(folder: Path) -> Path:
    """Returns the folder's `specs.json`, or its `config.json` where it has only that."""
    return folder / CONFIG if (folder / CONFIG).is_file() and not (folder / SPECS).is_file() else folder / SPECS


def write_specs(path: Path, specs: NetworkSpecs, shapes: tuple[str, ...]) -> None:
    """Writes a network's architecture and its shapes' names."""
    network = asdict(specs)
    length = network.pop("code_length")
    content = {"NetworkArch": "deep_sdf_decoder", "NetworkSpecs": network, "CodeLength": length, "Shapes": shapes}
    save_json(path, content)


def read_specs(folder: Path) -> tuple[NetworkSpecs, tuple[str, ...]]:
    """Returns a network's architecture and its shapes' names.

    Raises `ValueError`, in one sentence, for a file that is missing, or describes another architecture.
    """
    path = specs_path(folder)
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
