"""What the gradient of a depth image costs, beside the image itself."""

import time
from dataclasses import dataclass
from functools import partial
from statistics import median

import torch

from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF
from distrace.render import render


@dataclass(frozen=True)
class Timing:
    """What a depth image costs to render, and its gradient on top. Medians, of runs in turn."""

    parameter: str
    pixels: int
    visible: int
    forward: float  # seconds
    backward: float
    ratio: float
    runs: int


def timings(model: Model, code: int, camera: Camera, repeats: int) -> list[Timing]:
    """Times a depth image by the default tracer and its backward pass, by code and by camera, after a warm-up run."""
    ways = {"code": partial(_by_code, model, code, camera), "camera": partial(_by_camera, model, code, camera)}
    taken: dict[str, list[tuple[float, float, int]]] = {name: [] for name in ways}
    for _ in range(repeats + 1):
        for name, way in ways.items():
            taken[name].append(_timed(*way()))
    return [_timing(name, camera, times[1:] or times) for name, times in taken.items()]


def _timing(name: str, camera: Camera, times: list[tuple[float, float, int]]) -> Timing:
    forward, backward, visible = (list(column) for column in zip(*times))
    before, after = median(forward), median(backward)
    return Timing(name, camera.height * camera.width, visible[0], before, after, after / before, len(times))


def _by_code(model: Model, code: int, camera: Camera) -> tuple[SDF, Camera]:
    return model.field(model.codes[code].detach().clone().requires_grad_()), camera


def _by_camera(model: Model, code: int, camera: Camera) -> tuple[SDF, Camera]:
    intrinsics, pose = (part.detach().clone().requires_grad_() for part in (camera.intrinsics, camera.T_world_camera))
    return model.field(code), Camera(intrinsics, pose, camera.height, camera.width)


def _timed(sdf: SDF, camera: Camera) -> tuple[float, float, int]:
    """Seconds to trace, seconds from there to the gradient, and visible pixels."""
    began = time.perf_counter()
    buffers = render(sdf, camera)
    visible = int(buffers.mask.sum())
    traced = time.perf_counter()
    buffers.depth[buffers.mask].sum().backward()
    if camera.intrinsics.is_cuda:
        torch.cuda.synchronize()
    return traced - began, time.perf_counter() - traced, visible
