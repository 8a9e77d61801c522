"""The methods of completion that are compared: DeepSDF's, and this project's from more and more information."""

import torch

from distrace.checkpoints.model import Model
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.fitting.completing import NORMAL_OFFSET, complete_shape, signed_samples
from distrace.fitting.fit import FitConfig
from distrace.fitting.fit_code import CodeFit, CodeFitConfig
from distrace.fitting.free_space import MARGIN
from experiments.baselines.deepsdf import SampleFitConfig, fit_samples

METHODS = ("deepsdf", "ours", "ours+mask")  # of the published table
CLOUDS = ("points", "points+normals")  # ours, not knowing the camera
DEEPSDF = SampleFitConfig(samples=500)  # where the original has 8,000 in an iteration: docs/from_the_paper.md


def observation_of(view: View, method: str) -> View | Cloud:
    """Returns the part of a view that a method uses; the view has normals where the method takes them.

    Raises `ValueError` for another method.
    """
    if method not in METHODS + CLOUDS:
        raise ValueError(f"there is no method {method!r}; give some of {', '.join(METHODS + CLOUDS)}")
    if method in ("ours", "ours+mask"):
        return view.without("normal") if method == "ours+mask" else view.without("normal", "mask")
    normals = None if view.normal is None or method == "points" else view.normal[view.seen]
    return Cloud(view.points(), normals)


def completed_by(method: str, model: Model, seen: View | Cloud, config: FitConfig | CodeFitConfig) -> CodeFit:
    """Completes what `observation_of` returns by a method."""
    if method != "deepsdf":
        return complete_shape(model, seen, config)
    cloud = seen.to(model.codes.device)
    assert isinstance(cloud, Cloud)
    assert cloud.normals is not None, "DeepSDF is given the true normals"
    sides = [signed_samples(cloud.points, cloud.normals, side) for side in (-NORMAL_OFFSET, NORMAL_OFFSET)]
    return fit_samples(model.decoder, torch.cat(sides), DEEPSDF)


def settings_of(method: str, config: FitConfig | CodeFitConfig) -> tuple[object, ...]:
    """Returns the settings of a method."""
    return (DEEPSDF,) if method == "deepsdf" else (config, MARGIN)
