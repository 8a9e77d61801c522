"""The camera of one view of a known shape: its pose, and its focal length if asked for, by least squares."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.alignment import Accuracy, Scene, Sight, residuals
from distrace.camera import Camera
from distrace.data.view import View
from distrace.field import SDF
from distrace.pose import aimed, turned_object, zoomed
from distrace.rays import meet_sphere
from distrace.solver import Residuals, SolverConfig, minimise

REFINE = 2
GOOD = 0.01  # a loss below this: most rays agree within the accuracy


@dataclass(frozen=True)
class CameraConfig:
    """Levenberg–Marquardt from several starts, one after another until one agrees with what was observed."""

    rays: int = 450
    focal: bool = False  # also the focal length
    starts: int = 8
    turn: float = 35.0  # degrees by which further starts are turned
    accuracy: Accuracy = Accuracy()
    solver: SolverConfig = field(default_factory=lambda: SolverConfig(iterations=40, widest=30.0))
    seed: int = 0


@dataclass(frozen=True)
class CameraStep:
    start: int
    iteration: int
    camera: Camera
    loss: float
    disagreeing: float
    seconds: float


def fit_camera(sdf: SDF, view: View, start: Camera, config: CameraConfig = CameraConfig()) -> Iterator[CameraStep]:
    scene, sight = Scene.of(sdf, start.intrinsics), Sight.of(view, config.rays, config.seed)
    start = _facing(start, sight)
    best: CameraStep | None = None
    for k, first in enumerate(_starts(start, config)):
        for step in _descend(scene, sight, first, config, k):
            yield step
            if best is None or step.disagreeing < best.disagreeing:
                best = step
        if best.disagreeing < GOOD:
            break
    if view.mask is not None:
        sight = Sight.of(view, REFINE * config.rays, config.seed + 1, width=3)
        yield from _polish(scene, sight, best, config)
    else:
        yield best


def _descend(scene, sight, first, config, k):
    begins = first
    shifted = None
    for solution in minimise(
        lambda camera: _only_shift(residuals(scene, sight, camera, config.accuracy, focal=False)),
        first,
        lambda camera, step: turned_object(camera, torch.zeros_like(step), step),
        SolverConfig(iterations=4, widest=config.solver.widest, narrowing=1.0),
    ):
        begins = solution.state
        yield CameraStep(k, solution.iteration, solution.state, solution.loss, _off(solution), solution.seconds)
    losses = []
    for solution in minimise(
        lambda camera: residuals(scene, sight, camera, config.accuracy, focal=config.focal), begins, _moved, config.solver
    ):
        yield CameraStep(k, solution.iteration, solution.state, solution.loss, _off(solution), solution.seconds)
        losses.append(solution.loss)
        if len(losses) > 8 and _off(solution) > GOOD and losses[-1] > 0.8 * losses[-6]:
            return
        if _off(solution) < GOOD / 2:
            return


def _polish(scene, sight, best, config):
    for solution in minimise(
        lambda camera: residuals(scene, sight, camera, config.accuracy, focal=config.focal),
        best.camera,
        _moved,
        SolverConfig(iterations=10),
    ):
        yield CameraStep(best.start, best.iteration + solution.iteration, solution.state, solution.loss, _off(solution), solution.seconds)


def _off(solution):
    return float((solution.residuals.values.abs() > 1).sum() * solution.residuals.weights[:1].sum())


def _only_shift(found):
    return Residuals(found.values, found.jacobian[:, 3:6], found.weights)


def _moved(camera: Camera, step: Float[Tensor, "unknowns"]) -> Camera:
    turned = turned_object(camera, step[:3], step[3:6])
    return zoomed(turned, step[6]) if len(step) > 6 else turned


def _starts(start: Camera, config: CameraConfig) -> Iterator[Camera]:
    yield start
    angle = math.radians(config.turn)
    for k in range(config.starts - 1):
        axis = torch.zeros(3, dtype=start.intrinsics.dtype)
        sign = 1 if k % 2 == 0 else -1
        axis[(1, 0, 2)[k // 2 % 3]] = sign * angle
        yield turned_object(start, axis, torch.zeros_like(axis))


def _facing(start: Camera, sight: Sight) -> Camera:
    seen = sight.pixels[sight.is_object]
    if meet_sphere(start.rays(seen)).meets.any():
        return start
    return aimed(start, seen.mean(0))
