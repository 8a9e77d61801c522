"""Experiments of many trials that do not depend on each other: they go on where they were stopped."""

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.model import Model, load_model
from distrace.errors import explained
from distrace.fields.base import SDF
from distrace.mesh import MeshConfig

Result = TypeVar("Result")


@dataclass(frozen=True)
class Place:
    """Where meshes, models and results lie."""

    meshes: Path  # a folder for each source, as `distrace data` makes them
    out: Path
    models: tuple[tuple[str, str], ...]  # of each category
    resolution: int = 192  # of the meshes that are compared
    device: torch.device = torch.device("cpu")  # where shapes are completed

    def __post_init__(self) -> None:
        _ = self.mesh  # before any fit, raises for what no mesh has

    @property
    def mesh(self) -> MeshConfig:
        return MeshConfig(self.resolution, device=self.device)

    def model_of(self, category: str) -> Model:
        return opened_once(dict(self.models)[category], self.device)

    def field_of(self, category: str, code: Float[Tensor, "length"]) -> SDF:
        """On the device, wherever the code is."""
        return self.model_of(category).field(code.to(self.device))


def grouped(results: Iterable[Result], key: Callable[[Result], tuple]) -> dict[tuple, list[Result]]:
    """Results of one key together, in the order in which the keys first come."""
    groups: dict[tuple, list[Result]] = {}
    for each in results:
        groups.setdefault(key(each), []).append(each)
    return groups


@cache
def opened_once(name: str, device: torch.device = torch.device("cpu")) -> Model:
    """A model, read once by each process."""
    return load_model(name).to(device)


def read_json(path: Path) -> Any:
    """What a trial left. Raises `ValueError` for a file that is not JSON."""
    with explained(f"{path} holds no trials; remove it to begin anew"):
        return json.loads(path.read_text())


@lru_cache
def fingerprint(model: Model, *settings: object) -> str:
    """Tells models and settings apart: a change of a weight, or of a default, changes it."""
    digest = hashlib.sha256(repr(settings).encode())
    for tensor in (*model.decoder.state_dict().values(), model.codes):
        digest.update(tensor.cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


def hash_of(name: str) -> int:
    return int(hashlib.sha256(name.encode()).hexdigest()[:6], 16)
