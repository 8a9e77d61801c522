"""Signed samples of the training shapes, and the random batches of each step."""

import os
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.checkpoints.model import VARIANT
from distrace.errors import DoubtfulResult, about, error_context

MIN_MEDIAN_RADIUS = 0.012  # median distance from the origin of samples of a shape in the unit sphere, at least …
MAX_MEDIAN_RADIUS = 1.2  # … and at most
MAX_DISTANCE = 4.0  # distance of a sample from such a shape


@dataclass(frozen=True)
class Samples:
    """Signed samples of the training shapes: one tensor a shape, of points and distances."""

    names: list[str]
    outside: list[Float[Tensor, "_ 4"]]
    inside: list[Float[Tensor, "_ 4"]]

    @cached_property
    def sides(self) -> list[tuple[Float[Tensor, "_ 4"], Int[Tensor, "shapes"]]]:
        """Outside and inside: the samples of all shapes, concatenated for a single gather, and their counts."""
        sides = (self.outside, self.inside)
        return [(torch.cat(parts), torch.tensor([len(part) for part in parts])) for parts in sides]

    @cached_property
    def variant(self) -> Bool[Tensor, "shapes"]:
        return torch.tensor([VARIANT in name for name in self.names])

    def drawn(
        self, shapes: int, samples: int, variants: float
    ) -> tuple[Int[Tensor, "shapes"], Float[Tensor, "shapes n 4"]]:
        """Returns the numbers of random shapes, and `samples` of them in all: as many outside as inside.

        Variants are drawn with the weight `variants`, other shapes with 1.
        """
        chosen = torch.multinomial(torch.where(self.variant, variants, 1.0), min(shapes, len(self.names)))
        per_side = max(samples // len(chosen) // 2, 1)
        drawn = []
        for side, counts in self.sides:
            begins = counts.cumsum(0) - counts
            places = (torch.rand(len(chosen), per_side, dtype=torch.float64) * counts[chosen, None]).long()
            drawn.append(side[(begins[chosen, None] + places).to(side.device)])
        return chosen, torch.cat(drawn, dim=1)

    def to(self, device: torch.device) -> "Samples":
        return Samples(self.names, [s.to(device) for s in self.outside], [s.to(device) for s in self.inside])


def load_samples(paths: list[Path]) -> Samples:
    """Reads DeepSDF's `.npz` files; a shape is called by its file's name, and its folders' where two share one.

    Rows with values that are not finite are dropped, with a `DoubtfulResult`. Raises `ValueError` for a file without
    `pos` and `neg` of shape [n, 4], of one sign only, or of a shape that is not in the unit sphere.
    """
    outside = []
    inside = []
    dropped = 0
    for path in paths:
        with error_context(f"{path} is not a file of samples; one made by `distrace sample` holds pos and neg", path):
            with np.load(path, allow_pickle=False) as archive:
                sides = [archive[name].astype(np.float32, casting="same_kind") for name in ("pos", "neg")]
        with about(path):
            pos = _finite("pos", sides[0])
            neg = _finite("neg", sides[1])
            _check_sides(pos, neg)
        samples = np.concatenate([pos, neg])
        dropped += sum(map(len, sides)) - len(samples)
        outside.append(torch.from_numpy(samples[samples[:, 3] >= 0]))
        inside.append(torch.from_numpy(samples[samples[:, 3] < 0]))
    if dropped:
        warnings.warn(f"{dropped} samples that are not finite were dropped", DoubtfulResult, stacklevel=3)
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        root = Path(os.path.commonpath([path.parent for path in paths]))
        names = ["-".join(path.relative_to(root).with_suffix("").parts) for path in paths]
    return Samples(names, outside, inside)


def _finite(name: str, side: np.ndarray) -> Float[np.ndarray, "n 4"]:
    """The rows whose values are finite. Raises `ValueError` where there is none."""
    if side.ndim != 2 or side.shape[1] != 4 or not len(side):
        raise ValueError(f"{name} has shape {list(side.shape)}; rows of a point and its distance, [n, 4], are needed")
    finite = np.isfinite(side).all(axis=1)
    if not finite.any():
        raise ValueError(f"{name} has no row of finite values")
    return side[finite]


def _check_sides(pos: Float[np.ndarray, "_ 4"], neg: Float[np.ndarray, "_ 4"]) -> None:
    """Raises `ValueError` for distances of one sign only, and for a shape that is not in the unit sphere."""
    if not (pos[:, 3] > 0).any():
        raise ValueError(f"none of the {len(pos)} distances in pos is positive; pos lies outside of the shape")
    if not (neg[:, 3] < 0).any():
        raise ValueError(f"none of the {len(neg)} distances in neg is negative; neg lies inside of the shape")
    samples = np.concatenate([pos, neg])
    away = float(np.median(np.linalg.norm(samples[:, :3], axis=1)))
    farthest = float(np.abs(samples[:, 3]).max())
    if not MIN_MEDIAN_RADIUS < away < MAX_MEDIAN_RADIUS or farthest > MAX_DISTANCE:
        raise ValueError(
            f"its points lie {away:.3g} from the origin in the median, and up to {farthest:.3g} from the surface, but"
            " the shape must be in the unit sphere: divide by its largest radius"
        )
