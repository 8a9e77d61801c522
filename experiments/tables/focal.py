"""A shape fitted at one focal length, looked at through others: does what was never seen so look right?"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import torch

from distrace.data.observation import observe
from distrace.metrics import depth_errors, iou
from distrace.render import render
from experiments.tables.sparse_depth import RATIOS, Trial, camera_of, done, true_solid
from experiments.tables.trials import Place, grouped

COARSER = 0.5  # × the resolution of the observations


@dataclass(frozen=True)
class Look:
    """A completed shape seen at another focal length, against the true one."""

    category: str
    method: str
    focal_ratio: float
    depth_error: float  # median over the pixels where both are seen
    iou: float  # of the silhouettes


@torch.no_grad()
def looks(place: Place, trial: Trial) -> list[Look]:
    """At every focal length, from the direction of the observation."""
    field = place.field_of(trial.category, torch.tensor(done(place, trial).code))
    truth, found = true_solid(place.meshes, trial.category, trial.shape), []
    for ratio in RATIOS:
        camera = camera_of(trial.view, ratio).resized(COARSER)
        buffers, seen = render(field, camera.to(place.device)), observe(truth, camera)
        errors = depth_errors(buffers.depth.cpu(), seen.depth)
        error = errors.median().item() if len(errors) else float("inf")
        found.append(Look(trial.category, trial.method, ratio, error, iou(buffers.mask.cpu(), seen.seen)))
    return found


def look_rows(found: Sequence[Look]) -> list[dict[str, object]]:
    """Medians of each class, method and focal length."""
    groups = grouped(found, lambda each: (each.category, each.method, each.focal_ratio))
    return [
        {
            "class": category,
            "method": method,
            "tested_at": ratio,
            "depth_error_median": median(each.depth_error for each in some),
            "iou_median": median(each.iou for each in some),
            "n": len(some),
        }
        for (category, method, ratio), some in groups.items()
    ]
