"""The time of a depth image and of its gradient."""

import time
from dataclasses import dataclass, replace
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF
from distrace.render import render


@dataclass(frozen=True)
class Timing:
    """The time of a depth image and of its gradient. Medians, of runs in turn."""

    parameter: str
    pixels: int
    visible: int
    forward: float  # seconds
    backward: float
    ratio: float
    runs: int


def timings(model: Model, code: Float[Tensor, "length"], camera: Camera, repeats: int) -> list[Timing]:
    """Times a depth image of the default tracer and its backward pass, by code and by camera, after a warm-up run."""
    runs: dict[str, list[tuple[float, float, int]]] = {"code": [], "camera": []}
    for _ in range(repeats + 1):
        runs["code"].append(_timed(model.field(code.detach().clone().requires_grad_()), camera))
        runs["camera"].append(_timed(model.field(code), _attached(camera)))
    return [_timing(name, camera, times[1:] or times) for name, times in runs.items()]


def _timing(name: str, camera: Camera, times: list[tuple[float, float, int]]) -> Timing:
    forward, backward, visible = zip(*times)
    before = median(forward)
    after = median(backward)
    return Timing(name, camera.height * camera.width, visible[0], before, after, after / before, len(times))


def _attached(camera: Camera) -> Camera:
    """Returns a copy whose intrinsics and pose require gradients."""
    intrinsics = camera.intrinsics.detach().clone().requires_grad_()
    return replace(
        camera, intrinsics=intrinsics, T_world_camera=camera.T_world_camera.detach().clone().requires_grad_()
    )


def _timed(sdf: SDF, camera: Camera) -> tuple[float, float, int]:
    """Returns the seconds of tracing, the seconds from there to the gradient, and the number of visible pixels."""
    start = time.perf_counter()
    buffers = render(sdf, camera)
    visible = int(buffers.mask.sum())
    traced = time.perf_counter()
    buffers.depth[buffers.mask].sum().backward()
    if camera.intrinsics.is_cuda:
        torch.cuda.synchronize()
    return traced - start, time.perf_counter() - traced, visible
