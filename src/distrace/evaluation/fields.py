"""Fields that are not what sphere tracing assumes: too steep, too thin, too wild, too close, or clamped."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from distrace.camera import Camera
from distrace.evaluation.bench import OUTLIER, reference_depth
from distrace.field import SDF
from distrace.metrics import depth_errors
from distrace.primitives import box, sphere
from distrace.render import STRATEGIES, render
from distrace.trace import Outcome

CLAMP = 0.02
THICKNESS = 0.004
FREQUENCY, AMPLITUDE = 30.0, 0.06
COUNT = 5 * len(STRATEGIES)  # of rows


@dataclass(frozen=True)
class FieldRow:
    """How many pixels one strategy gets wrong on one field, and how many of those it admits (EXHAUSTED)."""

    field: str
    strategy: str
    visible: int
    wrong: int  # hit or not, or depth, by more than a thousandth
    admitted: int
    exhausted: int  # of all pixels
    queries: int


@dataclass(frozen=True)
class Hard:
    """A field, and a bound on its slope, by which the reference divides it."""

    sdf: SDF
    steepest: float


def hard_fields(decoder: SDF, camera: Camera) -> Mapping[str, Hard]:
    """By name; `decoder` is any well-trained one, and a gap is as wide as one pixel of the camera."""
    like = camera.intrinsics
    pixel = float(2 * camera.tolerance(1.0).max() * camera.T_world_camera[:3, 3].norm())
    return {
        "decoder × 2": Hard(lambda points: 2 * decoder(points), 2.5),
        "thin plate": Hard(box(like.new_tensor([0.6, THICKNESS / 2, 0.4])), 1.0),
        "high frequencies": Hard(_wild(like), 1 + 2 * AMPLITUDE * FREQUENCY),
        "gap of a pixel": Hard(_gap(pixel, like), 1.0),
        "clamped": Hard(lambda points: decoder(points).clamp(-CLAMP, CLAMP), 1.2),
    }


def field_rows(decoder: SDF, camera: Camera) -> Iterator[FieldRow]:
    """Every strategy on every field."""
    for name, hard in hard_fields(decoder, camera).items():
        truth = reference_depth(lambda points, hard=hard: hard.sdf(points) / hard.steepest, camera)
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


def _wild(like: Tensor) -> SDF:
    """A sphere and waves in random directions, as a network of sines has (Sitzmann et al., *SIREN*, NeurIPS 2020)."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(16, 3, generator=generator), dim=-1).to(like) * FREQUENCY
    phases = (torch.rand(16, generator=generator) * 6.283).to(like)
    ball = sphere(0.6)
    return lambda points: ball(points) + AMPLITUDE * torch.sin(points @ directions.T + phases).mean(-1) * 2


def _gap(width: float, like: Tensor) -> SDF:
    """Two boxes side by side."""
    half = box(like.new_tensor([0.3, 0.4, 0.3]))
    aside = like.new_tensor([0.3 + width / 2, 0.0, 0.0])
    return lambda points: torch.minimum(half(points - aside), half(points + aside))
