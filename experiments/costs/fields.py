"""Wrong pixels of every strategy on fields that break what sphere tracing assumes."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from distrace.benchmarks.measuring import OUTLIER, reference_depth
from distrace.camera import Camera
from distrace.fields.base import SDF
from distrace.metrics import depth_errors
from distrace.render import STRATEGIES, render
from distrace.tracing.sphere_tracing import Outcome
from experiments.fields.analytic import hard_fields

COUNT = 5 * len(STRATEGIES)  # of rows


@dataclass(frozen=True)
class FieldRow:
    """The wrong pixels of one strategy on one field, and those of them that are EXHAUSTED."""

    field: str
    strategy: str
    visible: int
    wrong: int  # missed or added, or off in depth by more than 0.001 radii
    admitted: int  # wrong and EXHAUSTED
    exhausted: int  # of all pixels
    queries: int


def field_rows(decoder: SDF, camera: Camera) -> Iterator[FieldRow]:
    """Yields every strategy on every field."""
    for name, hard in hard_fields(decoder, camera).items():
        truth = reference_depth(lambda points, hard=hard: hard.sdf(points) / hard.lipschitz, camera)
        for strategy, config in STRATEGIES.items():
            with torch.no_grad():
                buffers = render(hard.sdf, camera, config=config)
            wrong = _wrong(buffers.depth, truth)
            exhausted = buffers.trace.outcome == Outcome.EXHAUSTED
            yield FieldRow(
                name,
                strategy,
                visible=int(torch.isfinite(truth).sum()),
                wrong=int(wrong.sum()),
                admitted=int((wrong & exhausted).sum()),
                exhausted=int(exhausted.sum()),
                queries=buffers.trace.total_evaluations,
            )


def _wrong(depth: Tensor, truth: Tensor) -> Tensor:
    both = torch.isfinite(depth) & torch.isfinite(truth)
    off = torch.zeros_like(both).masked_scatter(both, depth_errors(depth, truth) > OUTLIER)
    return (torch.isfinite(depth) != torch.isfinite(truth)) | off
