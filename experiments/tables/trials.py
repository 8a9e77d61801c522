"""Experiments of many independent trials, which resume after a stop."""

import hashlib
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from distrace.checkpoints.model import Model, load_model
from distrace.errors import error_context
from distrace.fields.base import SDF
from distrace.fitting.placement_network import PlacementNetwork, load_placement_network
from distrace.mesh import MeshConfig

Result = TypeVar("Result")


@dataclass(frozen=True)
class Place:
    """The folders of meshes and results, and the models."""

    meshes: Path  # a folder for each source, as `distrace data` makes them
    out: Path
    models: tuple[tuple[str, str], ...]  # of each category
    resolution: int = 192  # of the meshes that are compared
    device: torch.device = torch.device("cpu")  # of the fits

    def __post_init__(self) -> None:
        _ = self.mesh  # raises for an invalid resolution before any fit

    @property
    def mesh(self) -> MeshConfig:
        return MeshConfig(self.resolution, device=self.device)

    def model_of(self, category: str) -> Model:
        return opened_once(dict(self.models)[category], self.device)

    def field_of(self, category: str, code: Float[Tensor, "length"]) -> SDF:
        """Returns the field of a code, on the device."""
        return self.model_of(category).field(code.to(self.device))


def grouped(results: Iterable[Result], key: Callable[[Result], tuple]) -> dict[tuple, list[Result]]:
    """Returns the results by key, in the order of the keys' first results."""
    groups: dict[tuple, list[Result]] = {}
    for each in results:
        groups.setdefault(key(each), []).append(each)
    return groups


@cache
def opened_once(name: str, device: torch.device = torch.device("cpu")) -> Model:
    """Returns a model; each process reads it once."""
    return load_model(name).to(device)


def read_json(path: Path) -> Any:
    """Returns a trial's file. Raises `ValueError` for a file that is not JSON."""
    with error_context(f"{path} holds no trials; remove it to start again"):
        return json.loads(path.read_text())


@cache
def network_once(name: str) -> PlacementNetwork | None:
    """Returns a model's placement network; each process reads it once."""
    return load_placement_network(name)


@lru_cache
def fingerprint(model: Model, *settings: object, network: nn.Module | None = None) -> str:
    """Returns a hash of the model's weights, of those of a network that starts the fit, and of the settings."""
    named = re.sub(r" at 0x[0-9a-f]+", "", repr(settings))  # functions, of which only the name stays the same
    digest = hashlib.sha256(named.encode())
    others = () if network is None else network.state_dict().values()
    for tensor in (*model.decoder.state_dict().values(), model.codes, *others):
        digest.update(tensor.cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


def hash_of(name: str) -> int:
    return int(hashlib.sha256(name.encode()).hexdigest()[:6], 16)
