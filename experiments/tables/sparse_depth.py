"""The published experiment: held-out shapes from ever fewer depths of one view (Liu et al., CVPR 2020, section 4.2).

Trials with noise on the depths, or at other focal lengths, make two more tables.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.data.shapes import Shape
from distrace.data.solid import Solid
from distrace.files import save_json
from distrace.fitting.fit_code import CodeFitConfig
from distrace.fitting.free_space import pruned_mesh
from distrace.metrics import chamfer
from experiments.datasets.noise import NOISES, noisy
from experiments.datasets.solids import observe, solid_of
from experiments.datasets.splits import on_side, shape_of
from experiments.tables.methods import completed_by, observation_of, settings_of
from experiments.tables.trials import Place, fingerprint, hash_of, read_json

DENSITIES = ("dense", "50%", "10%", "100", "50", "20")
RATIOS = (0.5, 0.71, 1.0, 1.41, 2.0)  # of focal lengths to the usual one
AZIMUTHS_ELEVATIONS = ((30, 20), (150, 30), (225, 40), (330, 10))
SIZE = 256
FOCAL_MM = 60.0
SENSOR_MM = 32.0
DISTANCE = 4.97  # at the usual focal length
EMPTY = np.zeros((1, 3))  # one point in the middle stands for an empty surface
NOISY_DENSITY = "10%"  # of the depths, for the tables of noise and of focal lengths


@dataclass(frozen=True)
class Trial:
    """A shape, a view of it, the observed part of the view, and the method that completes it."""

    category: str  # a split, and the model trained on it
    shape: str
    view: int
    method: str
    density: str = "dense"
    noise: str = "0%"
    focal_ratio: float = 1.0

    @property
    def file(self) -> str:
        parts = (self.shape, self.view, self.density, self.noise, f"{self.focal_ratio:g}", self.method)
        return f"{Path(self.category).stem}/{'_'.join(map(str, parts))}.json"


@dataclass(frozen=True)
class Done:
    """The distance of the completed surface from the true one."""

    trial: Trial
    chamfer_to: float
    chamfer_from: float
    seconds: float
    evaluations: int
    code: list[float]

    @property
    def chamfer(self) -> float:
        return self.chamfer_to + self.chamfer_from

    def row(self) -> dict[str, object]:
        """Returns all fields but the code, those of the trial included."""
        own = {name: value for name, value in asdict(self).items() if name not in ("trial", "code")}
        fields = asdict(self.trial) | own
        return {key: round(value, 4) if isinstance(value, float) else value for key, value in fields.items()}


def sparse_conditions() -> list[dict]:
    return [{"density": density} for density in DENSITIES]


def noise_conditions() -> list[dict]:
    return [{"density": NOISY_DENSITY, "noise": noise} for noise in NOISES]


def focal_conditions() -> list[dict]:
    return [{"density": NOISY_DENSITY, "focal_ratio": ratio} for ratio in RATIOS]


CONDITIONS = {"sparse-depth": sparse_conditions, "noise": noise_conditions, "focal": focal_conditions}


def all_trials(
    categories: Sequence[str], methods: Sequence[str], conditions: Sequence[dict], shapes: int | None, views: int
) -> list[Trial]:
    """Returns the trials of all held-out shapes, or of `shapes` evenly spread ones, view by view."""
    chosen = [(category, shape.name) for category in categories for shape in held_out(category, shapes)]
    return [
        Trial(category, shape, view, method, **condition)
        for view in range(views)
        for category, shape in chosen
        for condition in conditions
        for method in methods
    ]


def held_out(category: str, count: int | None = None) -> list[Shape]:
    """Returns a split's held-out shapes; `count` of them, evenly spread."""
    shapes = on_side("test", category)
    if count is None or count >= len(shapes):
        return shapes
    return [shapes[k * len(shapes) // count] for k in range(count)]


def camera_of(view: int, focal_ratio: float = 1.0) -> Camera:
    """Returns a camera, at a distance from which the unit sphere fills the same part of the image."""
    azimuth, elevation = AZIMUTHS_ELEVATIONS[view]
    distance = math.sqrt(1 + focal_ratio**2 * (DISTANCE**2 - 1))
    return Camera.orbit(
        azimuth, elevation, distance, focal_mm=FOCAL_MM * focal_ratio, sensor_mm=SENSOR_MM, height=SIZE, width=SIZE
    )


def observed(trial: Trial, meshes: Path) -> View:
    """Returns the observation of a trial, with true normals and mask."""
    seed = 4 * hash_of(trial.shape) + trial.view
    view = observe(true_solid(meshes, trial.category, trial.shape), camera_of(trial.view, trial.focal_ratio))
    view = noisy(view, trial.noise, seed)
    count = int(view.seen.sum())
    if trial.density == "dense":
        return view
    share = trial.density.endswith("%")
    return view.sparse(round(count * float(trial.density[:-1]) / 100) if share else int(trial.density), seed)


def done(place: Place, trial: Trial) -> Done:
    """Returns a trial's result, read from the file of a run with the same model and settings, or computed and saved."""
    path = place.out / "trials" / trial.file
    model = place.model_of(trial.category)
    config = CodeFitConfig()
    mark = fingerprint(model, place.resolution, *settings_of(trial.method, config))
    if path.is_file():
        content = read_json(path)
        if content.pop("made_by", None) == mark:
            return Done(Trial(**content.pop("trial")), **content)
    observation = observation_of(observed(trial, place.meshes), trial.method)
    fit = completed_by(trial.method, model, observation, config)
    surface = surface_of(place, trial, observation, fit.code)
    truth = true_solid(place.meshes, trial.category, trial.shape).surface
    distance = chamfer(EMPTY if surface is None else surface, truth)
    result = Done(
        trial,
        distance.to,
        distance.from_,
        fit.seconds,
        fit.evaluations,
        [round(x, 6) for x in fit.code.tolist()],
    )
    save_json(path, {"made_by": mark, **asdict(result)})
    return result


def surface_of(
    place: Place, trial: Trial, observation: View | Cloud, code: Float[Tensor, "length"]
) -> trimesh.Trimesh | None:
    """Returns the completed mesh of a trial's code, or None where it has no surface."""
    try:
        return pruned_mesh(place.field_of(trial.category, code), observation, place.mesh)
    except ValueError:
        return None


@lru_cache(maxsize=4)
def true_solid(meshes: Path, category: str, name: str) -> Solid:
    """Returns the solid of a shape of a split; cached."""
    return solid_of(shape_of(category, name), meshes)
