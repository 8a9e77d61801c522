"""The published experiment: held-out shapes from ever fewer depths of one view (Liu et al., CVPR 2020, section 4.2).

The same trials, with noise on the depths or at other focal lengths, make its two neighbours.
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
from distrace.data.observation import View, observe
from distrace.data.shapes import Shape
from distrace.data.solid import Solid, solid_of
from distrace.files import save_json
from distrace.fitting.continuation import CodeFitConfig
from distrace.fitting.free_space import completed
from distrace.fitting.methods import settings_of, steps_of, told
from distrace.metrics import chamfer
from experiments.datasets.noise import NOISES, noisy
from experiments.datasets.splits import on_side, shape_of
from experiments.tables.trials import Place, fingerprint, hash_of, read_json

DENSITIES = ("dense", "50%", "10%", "100", "50", "20")
RATIOS = (0.5, 0.71, 1.0, 1.41, 2.0)  # of focal lengths to the usual one
AZIMUTHS_ELEVATIONS = ((30, 20), (150, 30), (225, 40), (330, 10))
SIZE, FOCAL_MM, SENSOR_MM = 256, 60.0, 32.0
DISTANCE = 4.97  # at the usual focal length
NOISY_DENSITY = "10%"  # of the depths that noise and focal lengths are tried on


@dataclass(frozen=True)
class Trial:
    """One shape, one view of it, what is known of that, and who completes it."""

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
    """How far the completed surface is from the true one."""

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
        """All but the code."""
        return {key: round(value, 4) if isinstance(value, float) else value for key, value in self._flat().items()}

    def _flat(self) -> dict[str, object]:
        own = {name: value for name, value in asdict(self).items() if name not in ("trial", "code")}
        return asdict(self.trial) | own


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
    """Of all held-out shapes, or of some evenly spread over the list; all of them from one view, then from the next."""
    chosen = [(category, shape.name) for category in categories for shape in held_out(category, shapes)]
    return [
        Trial(category, shape, view, method, **condition)
        for view in range(views)
        for category, shape in chosen
        for condition in conditions
        for method in methods
    ]


def held_out(category: str, count: int | None = None) -> list[Shape]:
    """A split's shapes to test on; `count` of them, evenly spread."""
    shapes = on_side("test", category)
    if count is None or count >= len(shapes):
        return shapes
    return [shapes[k * len(shapes) // count] for k in range(count)]


def camera_of(view: int, focal_ratio: float = 1.0) -> Camera:
    """At another focal length from as far as lets the unit sphere fill as much of the image."""
    azimuth, elevation = AZIMUTHS_ELEVATIONS[view]
    distance = math.sqrt(1 + focal_ratio**2 * (DISTANCE**2 - 1))
    return Camera.orbit(
        azimuth, elevation, distance, focal_mm=FOCAL_MM * focal_ratio, sensor_mm=SENSOR_MM, height=SIZE, width=SIZE
    )


def observed(trial: Trial, meshes: Path) -> View:
    """What is known in a trial, and the true normals and mask with it."""
    seed = 4 * hash_of(trial.shape) + trial.view
    view = observe(true_solid(meshes, trial.category, trial.shape), camera_of(trial.view, trial.focal_ratio))
    view = noisy(view, trial.noise, seed)
    count = int(view.seen.sum())
    if trial.density == "dense":
        return view
    share = trial.density.endswith("%")
    return view.sparse(round(count * float(trial.density[:-1]) / 100) if share else int(trial.density), seed)


def done(place: Place, trial: Trial) -> Done:
    """A trial's result: that of an earlier run with the same model and settings, or a new one, left in a file."""
    path, model, config = place.out / "trials" / trial.file, place.model_of(trial.category), CodeFitConfig()
    mark = fingerprint(model, place.resolution, *settings_of(trial.method, config))
    if path.is_file():
        kept = read_json(path)
        if kept.pop("made_by", None) == mark:
            return Done(Trial(**kept.pop("trial")), **kept)
    seen = told(observed(trial, place.meshes), trial.method)
    steps = list(steps_of(model, seen, trial.method, config))
    code = steps[-1].code
    found = surface_of(place, trial, seen, code)
    truth = true_solid(place.meshes, trial.category, trial.shape).surface
    distance = chamfer(_nothing() if found is None else found, truth)
    result = Done(
        trial,
        distance.to,
        distance.from_,
        sum(step.seconds for step in steps),
        sum(step.evaluations for step in steps),
        [round(x, 6) for x in code.tolist()],
    )
    save_json(path, {"made_by": mark, **asdict(result)})
    return result


def surface_of(place: Place, trial: Trial, seen: View | Cloud, code: Float[Tensor, "length"]) -> trimesh.Trimesh | None:
    """What a trial's code makes of what was seen; none where it has no surface."""
    try:
        return completed(place.field_of(trial.category, code), seen, place.mesh)
    except ValueError:
        return None


def _nothing() -> np.ndarray:
    """What an empty surface is compared as: one point in the middle."""
    return np.zeros((1, 3))


@lru_cache(maxsize=4)
def true_solid(meshes: Path, category: str, name: str) -> Solid:
    """A shape of a split; looked for once."""
    return solid_of(shape_of(category, name), meshes)
