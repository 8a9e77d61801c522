"""The camera of one view of a known shape: its pose, and its focal length if it is unknown, by least squares."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.fields.base import SDF, Counted
from distrace.fitting.alignment import Accuracy, Still, residuals
from distrace.fitting.blurred import Blurred
from distrace.fitting.solver import Residuals, Solution, SolverConfig, minimise
from distrace.fitting.visibility import ObservedRays, outline_of, rays_of
from distrace.pose import aimed, pose_error, turned_object, zoomed
from distrace.rays import meet_sphere

AGREES = 0.03  # a start is good once no larger share of its rays is off by more than the accuracy …
AGREES_IF_REPEATED = 0.2  # … or no larger one than that, where another start ends at the same camera …
SAME = 1.0  # … to so many degrees, and percent of the distance
AXES = ((0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1))  # about which further starts are turned
STARTS_WITHOUT_GAIN = len(AXES)  # so many further starts that agree on no more rays are the last
PATIENCE, PROGRESS = 5, 0.8  # a start whose loss falls by less in so many iterations is given up

BLURS = (2.5, 1.2)  # pixels of a coarse grid
APPROACH = SolverConfig(iterations=10, damping=0.3, scale=100.0, settled=1e-2)


def _search() -> SolverConfig:
    return SolverConfig(iterations=40, widest=30.0)


@dataclass(frozen=True)
class CameraConfig:
    """Levenberg–Marquardt from a start, and from that start turned, until one agrees with what was observed."""

    rays: int = 240  # while searching …
    outline_rays: int = 600  # … and at last, along the outline
    focal: bool = False  # also find the focal length
    starts: int = 13
    turn: float = 30.0  # degrees, of the first six further starts; twice that of the next six
    accuracy: Accuracy = Accuracy()
    search: SolverConfig = field(default_factory=_search)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.starts < 1 or self.rays < 10:
            raise ValueError(f"{self.starts} starts and {self.rays} rays were given; it takes at least 1 and 10")


@dataclass(frozen=True)
class CameraStep:
    """The camera after an iteration; the last step's is the result."""

    start: int
    iteration: int
    camera: Camera
    loss: float
    off: float  # the share of rays through pixels' centres that are off by more than the accuracy
    seconds: float
    evaluations: int  # of the field, so far


def fit_camera(sdf: SDF, view: View, start: Camera, config: CameraConfig = CameraConfig()) -> Iterator[CameraStep]:
    """Finds the camera that sees a shape as it was observed; of `view`, nothing is used of where its camera is.

    The shape is shifted before it is turned. Where no ray of the object meets the unit sphere, the start is turned to
    face it. Of several starts the one that agrees on the most rays is refined along the outline.
    Raises `ValueError` where nothing was observed.
    """
    search = _Search(Counted(sdf), view, config)
    ends: list[CameraStep] = []  # the best step of each start
    for k, first in enumerate(_starts(search.facing(start), config)):
        steps = []
        for step in search.descend(first, k):
            yield step
            steps.append(step)
        ends.append(min(steps, key=_off))
        if _settled(ends):
            break
    yield from search.refine(min(ends, key=_off))


class _Search:
    def __init__(self, sdf: Counted, view: View, config: CameraConfig) -> None:
        self.sdf, self.view, self.config = sdf, view, config
        self.shape = Still.of(sdf, view.camera.intrinsics)
        self.rays = rays_of(view, config.rays, config.seed)
        vague = view.normal is not None and not view.depth.isfinite().any()
        self.blurred = [Blurred.of(self.shape, view, sigma) for sigma in BLURS] if vague else []

    def facing(self, start: Camera) -> Camera:
        seen = self.rays.pixels[self.rays.is_object]
        return start if meet_sphere(start.rays(seen)).meets.any() else aimed(start, seen.mean(0))

    def descend(self, first: Camera, k: int) -> Iterator[CameraStep]:
        """Shifts, then turns, too; ends early where rays agree, or where it leads nowhere."""
        for step in self.approach(first, k):
            yield step
            first = step.camera
        shift = replace(self.config.search, iterations=4, narrowing=1.0)
        for found in minimise(lambda camera: _shifts(self.off(camera)), first, _shifted, shift):
            first = found.state
            yield self.step(k, found)
        losses = []
        for found in minimise(self.off, first, _moved, self.config.search):
            step = self.step(k, found)
            yield step
            losses.append(step.loss)
            lost = len(losses) > PATIENCE + 3 and losses[-1] > PROGRESS * losses[-1 - PATIENCE]
            if step.off < AGREES / 2 or (lost and step.off > AGREES):
                return

    def approach(self, first: Camera, k: int) -> Iterator[CameraStep]:
        """By blurred images, where there are normals and no depth."""
        for images in self.blurred:
            for found in minimise(images.residuals, first, _moved, APPROACH):
                first = found.state
                yield self.step(k, replace(found, residuals=self.off(first)))

    def refine(self, best: CameraStep) -> Iterator[CameraStep]:
        """With more rays, and those along the outline that pass between pixels.

        Between pixels the outline is known to half a pixel only, which is no deviation: `off` leaves these rays out.
        """
        view, count = self.view, self.config.rays
        centres = rays_of(view, 2 * count, self.config.seed + 1)
        rays = centres
        if view.mask is not None:
            rays = rays + outline_of(view.mask, view.camera.pixels(), self.config.outline_rays)
        for found in minimise(
            lambda camera: self.off(camera, rays), best.camera, _moved, SolverConfig(iterations=6, settled=1e-3)
        ):
            yield self.step(best.start, replace(found, residuals=self.off(found.state, centres)))

    def off(self, camera: Camera, rays: ObservedRays | None = None) -> Residuals:
        return residuals(self.shape, rays or self.rays, camera, self.config.accuracy, focal=self.config.focal)

    def step(self, start: int, found: Solution[Camera]) -> CameraStep:
        off = float(found.residuals.weights[found.residuals.values.abs() > 1].sum())
        return CameraStep(start, found.iteration, found.state, found.loss, off, found.seconds, self.sdf.evaluations)


def _off(step: CameraStep) -> float:
    return step.off


def _settled(ends: list[CameraStep]) -> bool:
    """Whether further starts are not worth their time: the best agrees, or is found again, or long not bettered."""
    best = min(ends, key=_off)
    again = [end for end in ends if max(pose_error(end.camera, best.camera)) < SAME]
    return (
        best.off < AGREES
        or (best.off < AGREES_IF_REPEATED and len(again) > 1)
        or len(ends) - 1 - best.start >= STARTS_WITHOUT_GAIN
    )


def _shifts(found: Residuals) -> Residuals:
    return replace(found, jacobian=found.jacobian[:, 3:6])


def _shifted(camera: Camera, shift: Float[Tensor, "3"]) -> Camera:
    return turned_object(camera, torch.zeros_like(shift), shift)


def _moved(camera: Camera, step: Float[Tensor, "unknowns"]) -> Camera:
    turned = turned_object(camera, step[:3], step[3:6])
    return zoomed(turned, step[6]) if len(step) > 6 else turned


def _starts(start: Camera, config: CameraConfig) -> Iterator[Camera]:
    yield start
    for k in range(config.starts - 1):
        axis = start.intrinsics.new_tensor(AXES[k % len(AXES)])
        angle = math.radians(config.turn) * (1 + k // len(AXES))
        yield turned_object(start, axis * angle, torch.zeros_like(axis))
