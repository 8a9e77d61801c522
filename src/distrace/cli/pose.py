"""`pose`: the camera of one view of a known shape."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro

from distrace import shading
from distrace.antialiasing import clay_picture
from distrace.camera import Camera
from distrace.checkpoints.codes import named_code, save_code
from distrace.cli.common import NONE, CodeName, Flag, ModelName, Orbit, check_distance, default, opened_for
from distrace.cli.console import Run, progress, start
from distrace.data.observation import View, read_view, save_view
from distrace.fields.base import SDF
from distrace.fitting.fit_camera import AGREES_IF_REPEATED, CameraConfig, CameraStep, fit_camera
from distrace.pose import pose_error
from distrace.render import render

FRAMES = 8  # of the film strip
STEPS = 30  # of a typical fit, for the progress bar


@dataclass(frozen=True)
class Pose:
    """Find the camera of one view of a known shape.

    The fit compares depth, silhouette and normals. It starts from the observation's T_world_camera, or from --azimuth,
    --elevation and --distance.
    """

    model: tyro.conf.Positional[ModelName]
    observation: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OBSERVATION.npz")]]
    out: Path = Path("out/pose")
    code: CodeName = "0"
    ignore: Annotated[tuple[Literal["depth", "mask", "normal"], ...], NONE] = ()  # parts of the observation
    focal: Flag = False  # also find the focal length
    azimuth: Annotated[float | None, default("the observation's camera", "FLOAT")] = None
    """degrees, of the initial camera"""
    elevation: Annotated[float | None, default("20, with --azimuth", "FLOAT")] = None  # degrees
    distance: Annotated[float | None, default("4.97, with --azimuth", "FLOAT")] = None  # to the origin
    starts: int = CameraConfig.starts  # of the multi-start fit
    seed: int = 0
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        model = opened_for(run, self.model)
        observed = read_view(self.observation, self.ignore).to(run.device)
        code = named_code(model, self.code)
        field = model.field(code)
        first = replace(observed.camera, T_world_camera=self._initial_pose(observed.camera))
        steps = []
        with progress("fitting", STEPS) as bar:
            config = CameraConfig(starts=self.starts, focal=self.focal, seed=self.seed)
            for step in fit_camera(field, observed, first, config):
                steps.append(step)
                bar.advance(f"start {step.start + 1}, loss {step.loss:.4f}, {step.off:.1%} of the rays off")
        last = steps[-1]
        if not np.isfinite(last.loss):
            raise ValueError(
                f"{self.observation}: no camera was found, for the loss is {last.loss}; is its camera right?"
            )
        save_view(run.out / "posed.npz", replace(observed, camera=last.camera))
        save_code(run.out, code)
        chosen = [CameraStep(0, 0, first, 0, 0, 0, 0), *(step for step in steps if step.start == last.start)]
        shading.save_png(run.out / "filmstrip.png", _filmstrip(field, observed, chosen))
        self._finish(run, observed, steps)

    def _initial_pose(self, camera: Camera) -> torch.Tensor:
        """Returns the observation's pose, or that of the options."""
        check_distance(self.distance)
        if self.azimuth is not None:
            elevation = Orbit.elevation if self.elevation is None else self.elevation
            distance = Orbit.distance if self.distance is None else self.distance
            focal_px = float(camera.intrinsics[0, 0])
            around = Camera.orbit(self.azimuth, elevation, distance, focal_px=focal_px)
            return around.T_world_camera.to(camera.T_world_camera)
        if (self.elevation, self.distance) != (None, None):
            given = f"--elevation {self.elevation} --distance {self.distance}"
            raise ValueError(f"{given} were given without --azimuth; all three place the camera")
        return camera.T_world_camera

    def _finish(self, run: Run, observed: View, steps: list[CameraStep]) -> None:
        last = steps[-1]
        facts = {
            "T_world_camera": last.camera.T_world_camera.tolist(),
            "intrinsics": last.camera.intrinsics.tolist(),
            "share_of_rays_off": last.off,
            "loss": last.loss,
            "starts": max(step.start for step in steps) + 1,
            "iterations": len(steps),
            "evaluations": last.evaluations,
        }
        if last.off > AGREES_IF_REPEATED:
            run.warn(
                f"the camera is doubtful, for {last.off:.0%} of the rays disagree; try more --starts or another --code"
            )
        degrees, percent = pose_error(last.camera, observed.camera)
        focal = 100 * abs(float(last.camera.intrinsics[0, 0] / observed.camera.intrinsics[0, 0]) - 1)
        facts |= {"degrees_from_observation": degrees, "percent_from_observation": percent}
        facts |= {"focal_percent_from_observation": focal}
        run.finish(
            facts,
            f"{last.off:.1%} of the rays disagree; difference from the observation's camera: {degrees:.3f}°,"
            f" {percent:.3f} % of the distance, {focal:.3f} % of the focal length",
        )


def _filmstrip(field: SDF, observed: View, steps: list[CameraStep]) -> shading.Picture:
    """Returns steps of the fit: above, the observed and the rendered mask; below, the rendered shape."""
    mask = observed.seen if observed.mask is None else observed.mask
    picked = [steps[round(k * (len(steps) - 1) / (FRAMES - 1))] for k in range(min(FRAMES, len(steps)))]
    with torch.no_grad():
        views = [render(field, step.camera) for step in picked]
    compared = [shading.mask_comparison(mask, view.mask) for view in views]
    return shading.grid([compared, list(map(clay_picture, views))])
