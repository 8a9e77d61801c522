"""The samples that a training learns from, and what is drawn of them for each step."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.checkpoints.model import VARIANT
from distrace.errors import explained

Batch = tuple[Int[Tensor, "shapes"], Float[Tensor, "shapes n 4"]]
"""Numbers of shapes, and samples of each: as many outside as inside."""


@dataclass(frozen=True)
class Side:
    """The samples of all shapes on one side of their surfaces, one shape's after another's: drawn in one go."""

    samples: Float[Tensor, "n 4"]
    begins: Int[Tensor, "shapes"]
    counts: Int[Tensor, "shapes"]

    @staticmethod
    def of(parts: list[Float[Tensor, "_ 4"]]) -> "Side":
        counts = torch.tensor([len(part) for part in parts])
        return Side(torch.cat(parts), counts.cumsum(0) - counts, counts)

    def drawn(self, shapes: Int[Tensor, "some"], number: int) -> Float[Tensor, "some number 4"]:
        """As many of each of the shapes, at random."""
        places = (torch.rand(len(shapes), number, dtype=torch.float64) * self.counts[shapes, None]).long()
        return self.samples[(self.begins[shapes, None] + places).to(self.samples.device)]


@dataclass(frozen=True)
class Samples:
    """Signed samples of the shapes to learn."""

    names: list[str]
    outside: list[Float[Tensor, "_ 4"]]
    inside: list[Float[Tensor, "_ 4"]]

    @cached_property
    def sides(self) -> tuple[Side, Side]:
        return Side.of(self.outside), Side.of(self.inside)

    @cached_property
    def variant(self) -> Bool[Tensor, "shapes"]:
        return torch.tensor([VARIANT in name for name in self.names])

    def drawn(self, shapes: int, samples: int, variants: float) -> Batch:
        """So many shapes, of which variants are drawn less often, and of all together so many samples."""
        some = torch.multinomial(torch.where(self.variant, variants, 1.0), min(shapes, len(self.names)))
        per_side = max(samples // len(some) // 2, 1)
        return some, torch.cat([side.drawn(some, per_side) for side in self.sides], dim=1)

    def to(self, device: torch.device) -> "Samples":
        return Samples(self.names, [s.to(device) for s in self.outside], [s.to(device) for s in self.inside])


def load_samples(paths: list[Path]) -> Samples:
    """Reads DeepSDF's `.npz` files. Raises `ValueError` for a file without `pos` and `neg` of shape [n, 4]."""
    outside, inside = [], []
    for path in paths:
        with explained(f"{path} is not a file of samples; one made by `distrace sample` holds pos and neg", path):
            with np.load(path, allow_pickle=False) as archive:
                pos, neg = (archive[name].astype(np.float32, casting="same_kind") for name in ("pos", "neg"))
        for name, part in (("pos", pos), ("neg", neg)):
            if part.ndim != 2 or part.shape[1] != 4 or not len(part) or not np.isfinite(part).all():
                raise ValueError(
                    f"{path}: {name} has shape {list(part.shape)}; finite values of shape [n, 4] are needed"
                )
        outside.append(torch.from_numpy(pos))
        inside.append(torch.from_numpy(neg))
    return Samples([path.stem for path in paths], outside, inside)
