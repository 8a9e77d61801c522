"""Renders a shape fitted at one focal length at all of them: is the surface right from new distances?"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import torch

from distrace.metrics import depth_errors, iou
from distrace.render import render
from experiments.datasets.solids import observe
from experiments.tables.sparse_depth import RATIOS, Trial, camera_of, done, true_solid
from experiments.tables.trials import Place, grouped

COARSER = 0.5  # × the resolution of the observations


@dataclass(frozen=True)
class Rendering:
    """The errors of a completed shape rendered at another focal length."""

    category: str
    method: str
    focal_ratio: float
    depth_error: float  # median over the pixels where both hit
    iou: float  # of the silhouettes


@torch.no_grad()
def renderings_of(place: Place, trial: Trial) -> list[Rendering]:
    """Renders a trial's shape at every focal length, from the direction of the observation."""
    field = place.field_of(trial.category, torch.tensor(done(place, trial).code))
    truth = true_solid(place.meshes, trial.category, trial.shape)
    renderings = []
    for ratio in RATIOS:
        camera = camera_of(trial.view, ratio).resized(COARSER)
        buffers = render(field, camera.to(place.device))
        observed = observe(truth, camera)
        errors = depth_errors(buffers.depth.cpu(), observed.depth)
        error = errors.median().item() if len(errors) else float("inf")
        overlap = iou(buffers.mask.cpu(), observed.seen)
        renderings.append(Rendering(trial.category, trial.method, ratio, error, overlap))
    return renderings


def rendering_rows(renderings: Sequence[Rendering]) -> list[dict[str, object]]:
    """Returns medians of each class, method and focal length."""
    groups = grouped(renderings, lambda each: (each.category, each.method, each.focal_ratio))
    return [
        {
            "class": category,
            "method": method,
            "tested_at": ratio,
            "depth_error_median": median(each.depth_error for each in group),
            "iou_median": median(each.iou for each in group),
            "n": len(group),
        }
        for (category, method, ratio), group in groups.items()
    ]
