"""The share of disturbed cameras that are found: protocol, rows and page."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import median

import roma
import torch

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.errors import error_context
from distrace.files import save_json
from distrace.fitting.fit_camera import CameraConfig, fit_camera
from distrace.pose import object_in_camera, pose_error, turned_object, with_object_at, zoomed
from distrace.render import render
from distrace.report.page import page, paragraph, section, short, table
from experiments.charts import steps_chart
from experiments.tables.trials import opened_once

SIGMA = "sigma 0.1"  # of each entry of quaternion and translation, as in DIST
DISTURBANCES = (SIGMA, "10°", "20°", "40°", "60°")  # with a shift by a tenth of the distance
OBSERVATIONS = ("depth+silhouette", "depth", "silhouette", "depth+silhouette+normal", "normal")
PARTS = {"depth": "depth", "silhouette": "mask", "normal": "normal"}  # names of a view's parts
FOCAL = "depth+silhouette, focal length off by 20 %"
PROTOCOL = [(observation, by) for observation in OBSERVATIONS for by in DISTURBANCES] + [(FOCAL, "10°")]
SIZE = 192  # pixels
FIRST_SEED = 1000  # of cameras that the fit was not tuned on
DEGREES = 0.5  # largest error of rotation
PERCENT = 0.5  # largest error of translation, of the distance


@dataclass(frozen=True)
class Trial:
    """One camera, one disturbance, one kind of observation."""

    observation: str
    disturbance: str
    camera: int


@dataclass(frozen=True)
class Found:
    """The errors of the fitted camera."""

    trial: Trial
    degrees: float
    percent: float  # of the distance
    focal_percent: float
    off: float
    starts: int
    seconds: float
    evaluations: int

    @property
    def success(self) -> bool:
        return self.degrees < DEGREES and self.percent < PERCENT

    def asdict(self) -> dict:
        return {**asdict(self.trial), **{name: value for name, value in asdict(self).items() if name != "trial"}}


def all_trials(cameras: int) -> list[Trial]:
    """Returns the whole protocol, camera by camera; depth with silhouette comes first.

    The focal length is fitted from the mildest rotation only.
    """
    trials = [Trial(observation, by, k) for k in range(cameras) for observation, by in PROTOCOL]
    return sorted(trials, key=lambda trial: trial.observation not in (OBSERVATIONS[0], FOCAL))


def write_trials(path: Path, model: str, done: Sequence[Found]) -> None:
    save_json(path, {"model": model, "trials": [each.asdict() for each in done]})


def read_trials(path: Path, model: str) -> list[Found]:
    """Returns the trials of a file, none without a file. Raises `ValueError` for those of another model."""
    if not path.is_file():
        return []
    with error_context(f"{path} holds no trials; remove it to start again"):
        content = json.loads(path.read_text())
        done = [Found(Trial(*(row.pop(part.name) for part in fields(Trial))), **row) for row in content["trials"]]
        owner = str(content["model"])
    if owner != model:
        raise ValueError(f"{path} holds trials of {owner}, not of {model}; give another --out")
    return done


def found(model: str, trial: Trial) -> Found:
    shapes = opened_once(model)
    random = torch.Generator().manual_seed(FIRST_SEED + trial.camera)
    camera = random_camera(random)
    field = shapes.field(trial.camera % len(shapes.codes))
    with torch.no_grad():
        buffers = render(field, camera)
        view = View(camera, buffers.depth, buffers.mask, buffers.normal)
    view = view.without(*(part for name, part in PARTS.items() if name not in trial.observation))
    start = disturbed(camera, trial.disturbance, random)
    focal = trial.observation == FOCAL
    if focal:
        start = zoomed(start, torch.tensor(1.2 if trial.camera % 2 else 0.8).log())
    steps = list(fit_camera(field, view, start, CameraConfig(focal=focal)))
    degrees, percent = pose_error(steps[-1].camera, camera)
    ratio = float(steps[-1].camera.intrinsics[0, 0] / camera.intrinsics[0, 0])
    return Found(
        trial,
        degrees,
        percent,
        100 * abs(ratio - 1),
        steps[-1].off,
        max(step.start for step in steps) + 1,
        sum(step.seconds for step in steps),
        steps[-1].evaluations,
    )


def random_camera(random: torch.Generator) -> Camera:
    """Returns a camera at a random azimuth, elevations from −10° to 50°, and 3.5 to 5.5 radii."""
    azimuth, elevation, distance = torch.rand(3, generator=random).tolist()
    return Camera.orbit(360 * azimuth, 60 * elevation - 10, 3.5 + 2 * distance, height=SIZE, width=SIZE)


def disturbed(camera: Camera, how: str, random: torch.Generator) -> Camera:
    """Returns the camera with noise on quaternion and translation, or rotated by `how` and shifted by a tenth."""
    rotation, translation = object_in_camera(camera)
    if how == SIGMA:
        noise = 0.1 * torch.randn(7, generator=random)
        quaternion = roma.rotmat_to_unitquat(rotation) + noise[:4]
        return with_object_at(camera, roma.unitquat_to_rotmat(quaternion / quaternion.norm()), translation + noise[4:])
    axis, shift = (each / each.norm() for each in torch.randn(2, 3, generator=random))
    angle = torch.deg2rad(torch.tensor(float(how.removesuffix("°"))))
    return turned_object(camera, axis * angle, shift * translation.norm() / 10)


def rows_of(model: str, done: Sequence[Found]) -> list[dict[str, object]]:
    """Returns one row for each observation and disturbance."""
    rows = []
    for observation, disturbance in PROTOCOL:
        of_row = (observation, disturbance)
        group = [each for each in done if (each.trial.observation, each.trial.disturbance) == of_row]
        if not group:
            continue
        rows.append(
            {
                "model": model,
                "observation": observation,
                "disturbance": disturbance,
                "success": sum(each.success for each in group) / len(group),
                "rotation_median_degrees": median(each.degrees for each in group),
                "translation_median_percent": median(each.percent for each in group),
                "focal_median_percent": median(each.focal_percent for each in group),
                "starts": sum(each.starts for each in group) / len(group),
                "seconds": median(each.seconds for each in group),
                "n": len(group),
            }
        )
    return rows


def pose_page(model: str, rows: Sequence[dict[str, object]]) -> str:
    """Returns the page: the table, and the share of cameras found against the disturbance."""
    cells = [[short(value) for key, value in row.items() if key != "model"] for row in rows]
    series = {
        observation: {
            str(row["disturbance"]): 100 * float(str(row["success"]))
            for row in rows
            if row["observation"] == observation
        }
        for observation in dict.fromkeys(str(row["observation"]) for row in rows)
    }
    lead = (
        f"Cameras around the training shapes of {model}, {SIZE} × {SIZE} pixels. Found: within {DEGREES}° and"
        f" {PERCENT} % of the distance. Starts: N(0, 0.1²) on each entry of quaternion and translation, as in DIST; or"
        " rotated about a random axis, and shifted by 10 % of the distance."
    )
    return page(
        f"Camera from one view: {model}",
        lead,
        [
            section("Share of cameras found", steps_chart(series, "disturbance of the start", "found, %")),
            section("Table", table([key for key in rows[0] if key != "model"], cells)),
            paragraph("Seconds are of one thread, with other processes running."),
        ],
    )
