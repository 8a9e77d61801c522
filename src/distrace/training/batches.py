"""Signed samples of the training shapes, and the random batches of each step."""

import os
import warnings
from collections.abc import Sequence
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
class Side:
    """The samples of all shapes outside of them, or inside: rows of a point and its distance, shape after shape."""

    rows: Float[Tensor, "n 4"]
    counts: Int[Tensor, "shapes"]

    @staticmethod
    def of(parts: Sequence[Float[Tensor, "_ 4"]]) -> "Side":
        """Returns a side from the rows of each shape."""
        return Side(torch.cat(list(parts)), torch.tensor([len(part) for part in parts]))

    @cached_property
    def parts(self) -> tuple[Float[Tensor, "_ 4"], ...]:
        """The rows of each shape."""
        return self.rows.split(self.counts.tolist())

    def to(self, device: torch.device) -> "Side":
        return Side(self.rows.to(device), self.counts)


@dataclass(frozen=True)
class Samples:
    """Signed samples of the training shapes."""

    names: list[str]
    outside: Side
    inside: Side

    @cached_property
    def variant(self) -> Bool[Tensor, "shapes"]:
        return torch.tensor([VARIANT in name for name in self.names])

    def draw(
        self, shapes: int, samples: int, variants: float
    ) -> tuple[Int[Tensor, "shapes"], Int[Tensor, "sides shapes n"]]:
        """Returns the numbers of random shapes, and of `samples` of their rows in all: as many outside as inside.

        Variants are drawn with the weight `variants`, other shapes with 1.
        """
        chosen = torch.multinomial(torch.where(self.variant, variants, 1.0), min(shapes, len(self.names)))
        per_side = max(samples // len(chosen) // 2, 1)
        rows = []
        for side in (self.outside, self.inside):
            counts = side.counts
            begins = counts.cumsum(0) - counts
            places = (torch.rand(len(chosen), per_side, dtype=torch.float64) * counts[chosen, None]).long()
            rows.append(begins[chosen, None] + places)
        return chosen, torch.stack(rows)

    def at(self, rows: Int[Tensor, "sides shapes n"]) -> Float[Tensor, "shapes m 4"]:
        """Returns the samples of rows that `draw` numbers, those outside before those inside."""
        sides = zip((self.outside, self.inside), rows, strict=True)
        return torch.cat([side.rows[numbers.to(side.rows.device)] for side, numbers in sides], dim=1)

    def to(self, device: torch.device) -> "Samples":
        return Samples(self.names, self.outside.to(device), self.inside.to(device))


def load_samples(paths: list[Path]) -> Samples:
    """Reads DeepSDF's `.npz` files; a shape is called by its file's name, and its folders' where two share one.

    Rows with values that are not finite are dropped, with a `DoubtfulResult`. Raises `ValueError` for a file without
    `pos` and `neg` of shape [n, 4], of one sign only, or of a shape that is not in the unit sphere.
    """
    outside, inside, dropped = zip(*map(read_samples, paths), strict=True)
    warn_of_dropped(sum(dropped))
    return Samples(shape_names(paths), Side.of(outside), Side.of(inside))


def read_samples(path: Path) -> tuple[Float[Tensor, "outside 4"], Float[Tensor, "inside 4"], int]:
    """Returns the samples in a file, and the number of its rows that are not finite. Raises as `load_samples` does."""
    with error_context(f"{path} is not a file of samples; one made by `distrace sample` holds pos and neg", path):
        with np.load(path, allow_pickle=False) as archive:
            sides = [archive[name].astype(np.float32, casting="same_kind") for name in ("pos", "neg")]
    with about(path):
        pos = _finite("pos", sides[0])
        neg = _finite("neg", sides[1])
        _check_sides(pos, neg)
    samples = np.concatenate([pos, neg])
    dropped = sum(map(len, sides)) - len(samples)
    outside = torch.from_numpy(samples[samples[:, 3] >= 0])
    return outside, torch.from_numpy(samples[samples[:, 3] < 0]), dropped


def warn_of_dropped(rows: int) -> None:
    if rows:
        warnings.warn(f"{rows} samples that are not finite were dropped", DoubtfulResult, stacklevel=4)


def shape_names(paths: list[Path]) -> list[str]:
    """Returns what the shapes of files are called."""
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        root = Path(os.path.commonpath([path.parent for path in paths]))
        names = ["-".join(path.relative_to(root).with_suffix("").parts) for path in paths]
    return names


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
