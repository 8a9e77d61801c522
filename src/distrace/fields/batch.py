"""The signed distance fields of several shapes, evaluated together."""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.equality import summary
from distrace.fields.base import SDF, flattened

Evaluate = Callable[[Float[Tensor, "n 3"], Int[Tensor, "n"]], Float[Tensor, "n"]]
"""From points, and the number of each point's shape, to values."""


class BatchField:
    """The fields of B shapes: the points of all of them go through the network in one product a layer.

    `field(points)` takes points [B, ..., 3], a set for each shape, and returns values [B, ...]. `field[b]` is the field
    of one shape. `model.field(codes)` makes one.
    """

    def __init__(
        self,
        codes: Float[Tensor, "shapes length"],
        evaluate: Evaluate,
        single: Callable[[Float[Tensor, "length"]], SDF],
    ) -> None:
        """`single` makes one shape's field from its code."""
        self.codes = codes
        self.evaluate = evaluate
        self.single = single

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} shapes, codes={summary(self.codes)})"

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, shape: int) -> SDF:
        return self.single(self.codes[shape])

    def __iter__(self) -> Iterator[SDF]:
        return map(self.single, self.codes)

    def __call__(self, points: Float[Tensor, "shapes *batch 3"]) -> Float[Tensor, "shapes *batch"]:
        """Returns values at points of each shape. Raises `ValueError` for points of another number of shapes."""
        if points.dim() < 2 or len(points) != len(self):
            given = list(points.shape)
            takes = [len(self), "...", 3]
            raise ValueError(f"points of shape {given} were given to a field of {len(self)} shapes; give {takes}")
        shape = torch.arange(len(self), device=points.device)
        return self.values(points, shape.reshape(-1, *[1] * (points.dim() - 2)))

    def select(self, shape: Int[Tensor, "n"]) -> "Selection":
        """Returns the field of points [..., n, 3]; those at index k of the last batch axis belong to shape `shape[k]`.

        Raises `ValueError` for shapes that the batch has not.
        """
        if len(shape) and not 0 <= int(shape.min()) <= int(shape.max()) < len(self):
            given = f"{int(shape.min())} to {int(shape.max())}"
            raise ValueError(f"shapes {given} were selected; there are {len(self)}, counted from 0")
        return Selection(self.values, shape)

    def values(self, points: Float[Tensor, "*batch 3"], shape: Int[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
        """Returns values at points, each of the shape of its number."""
        shape_of_point = shape.expand(points.shape[:-1]).reshape(-1)
        return flattened(lambda flat: self.evaluate(flat, shape_of_point), points)


class Selection:
    """A field of points [..., n, 3] that belong to different shapes, as `BatchField.select` says."""

    def __init__(self, values: Callable[[Tensor, Tensor], Tensor], shape: Int[Tensor, "n"]) -> None:
        self.values = values
        self.shape = shape

    def __repr__(self) -> str:
        return f"Selection(shape={summary(self.shape)})"

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Raises `ValueError` for another number of points along the last batch axis."""
        count = len(self.shape)
        if points.dim() < 2 or points.shape[-2] != count:
            given = list(points.shape)
            takes = ["...", count, 3]
            raise ValueError(f"points of shape {given} were given, but {count} shapes selected; give {takes}")
        return self.values(points, self.shape)

    def at_rows(self, rows: Int[Tensor, "m"]) -> "Selection":
        """Returns the field of a subset of the points, by their numbers."""
        return Selection(self.values, self.shape[rows])


class CountedBatch(BatchField):
    """The same fields; counts the points at which each shape is evaluated in a batch."""

    def __init__(self, field: BatchField) -> None:
        super().__init__(field.codes, field.evaluate, field.single)
        self.evaluations = [0] * len(field)

    def values(self, points: Float[Tensor, "*batch 3"], shape: Int[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
        counts = torch.bincount(shape.expand(points.shape[:-1]).reshape(-1), minlength=len(self)).tolist()
        self.evaluations[:] = [before + count for before, count in zip(self.evaluations, counts, strict=True)]
        return super().values(points, shape)

    def counting(self, field: BatchField) -> "CountedBatch":
        """Returns another form of the same fields, which counts here, too."""
        counted = CountedBatch(field)
        counted.evaluations = self.evaluations
        return counted
