"""Held-out shapes from clips, no depth, no masks: against masks alone, the training shapes, and classical stereo.

The protocol is DIST's (Liu et al., CVPR 2020, section 4.3): cameras are known, the code is not; and beside it the
shape's place, too, is off at first.
"""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.model import Model
from distrace.data.observation import View
from distrace.data.photographs import Photograph, load_photographs
from distrace.data.pictures import read_mask
from distrace.errors import explained
from distrace.files import save_json, written
from distrace.fitting.continuation import CodeFitConfig
from distrace.fitting.fit_code import fit_code
from distrace.mesh import MeshConfig, extract_mesh
from distrace.metrics import chamfer, surface_points
from distrace.photos.fit_photos import KNOWN_PLACE, UNKNOWN_PLACE, PhotoConfig, fit_photos
from distrace.photos.initialisation import Initialiser
from distrace.photos.pyramid import PyramidLevel
from distrace.pose import Similarity
from distrace.prior import prior_of
from experiments.baselines.semi_global import stereo_points
from experiments.tables.sparse_depth import true_solid
from experiments.tables.trials import fingerprint, grouped, hash_of, opened_once, read_json

METHODS = ("nearest", "silhouettes", "stereo", "ours", "ours, moved")
MOVED_BY = (10.0, 0.1, 0.1)  # degrees, radii, and part of the size
RECOVERED = (2.0, 0.02, 0.02)  # a fifth of that: to so much, the place counts as found again
REGISTERED = 10_000  # points of each surface, for what a registration would still move
RESOLUTION = 192

Surface = trimesh.Trimesh | np.ndarray  # or points of it


@dataclass(frozen=True)
class ClipTrial:
    """A clip as `distrace clip` leaves it, and who finds the shape in it."""

    folder: Path
    method: str
    meshes: Path
    out: Path
    model: str | None = None  # by default that of the clip's split

    def file(self, suffix: str) -> Path:
        """What the trial leaves: its figures (.json), and its surface (.ply)."""
        clip = described(self.folder)
        name = "_".join((clip["shape"], clip["background"], clip["texture"], self.method))
        return self.out / "trials" / f"{name}{suffix}"


@dataclass(frozen=True)
class ClipResult:
    """How far the found surface is from the true one, in the world; and how it would best be moved there."""

    category: str
    shape: str
    background: str
    texture: str
    method: str
    chamfer_to: float
    chamfer_from: float
    seconds: float
    degrees: float
    shift: float
    growth: float
    code: list[float]  # of stereo, none

    @property
    def chamfer(self) -> float:
        return self.chamfer_to + self.chamfer_from

    @property
    def recovered(self) -> bool:
        return all(off <= limit for off, limit in zip((self.degrees, self.shift, self.growth), RECOVERED, strict=True))

    def row(self) -> dict[str, object]:
        """All but the code."""
        return {name: value for name, value in asdict(self).items() if name != "code"}


def clip_done(trial: ClipTrial) -> ClipResult:
    """A trial's result: that of an earlier run with the same model and settings, or a new one, left in a file."""
    clip = described(trial.folder)
    model = opened_once(trial.model or clip["split"])
    mark = fingerprint(model, tuple(sorted(clip.items())), settings_of(trial.method))
    if trial.file(".json").is_file() and trial.file(".ply").is_file():
        kept = read_json(trial.file(".json"))
        if kept.pop("made_by", None) == mark:
            return ClipResult(**kept)
    began, code = time.perf_counter(), torch.zeros(0)
    if trial.method == "stereo":
        surface: Surface = stereo_points(load_photographs(trial.folder).views)
        seconds = time.perf_counter() - began
    else:
        code, place = _found(trial, model, clip)
        seconds = time.perf_counter() - began
        surface = extract_mesh(model.field(code), MeshConfig(RESOLUTION))
        surface.apply_transform(place.T_world_object.numpy())
    true = true_solid(trial.meshes, clip["split"], clip["shape"]).surface
    distance, off = chamfer(surface, true), left_over(surface, true)
    names = clip["split"], clip["shape"], clip["background"], clip["texture"], trial.method
    result = ClipResult(*names, distance.to, distance.from_, seconds, *off, [round(x, 6) for x in code.tolist()])
    with written(trial.file(".ply")) as file:
        (trimesh.PointCloud(surface) if isinstance(surface, np.ndarray) else surface).export(file, file_type="ply")
    save_json(trial.file(".json"), {"made_by": mark, **asdict(result)})
    return result


def surface_of(trial: ClipTrial) -> Surface:
    """What a trial that is done has found."""
    found: Any = trimesh.load(trial.file(".ply"), process=False)
    return found if isinstance(found, trimesh.Trimesh) else np.asarray(found.vertices)


def left_over(surface: Surface, true: trimesh.Trimesh) -> tuple[float, float, float]:
    """What a similarity by iterative closest points still moves a surface by: degrees, radii, and part of its size.

    A code can make a shape larger and the place smaller: neither is right or wrong alone.
    """
    points = surface if isinstance(surface, np.ndarray) else surface_points(surface, REGISTERED, seed=0)
    goal = surface_points(true, REGISTERED, seed=1)
    kept = {"threshold": 1e-9, "max_iterations": 100, "reflection": False}
    matrix = torch.from_numpy(trimesh.registration.icp(points, goal, **kept)[0]).float()
    scale = matrix[:3, :3].det().abs() ** (1 / 3)
    step = Similarity(matrix[:3, :3] / scale, matrix[:3, 3], scale).step_from(Similarity.identity())
    return math.degrees(float(step[:3].norm())), float(step[3:6].norm()), abs(math.expm1(float(step[6])))


def described(folder: Path) -> dict[str, Any]:
    """What `clip.json` says; raises `ValueError` for a folder without one."""
    path = folder / "clip.json"
    with explained(f"{path} is no description of a clip; `distrace clip SHAPE` makes one"):
        return dict(json.loads(path.read_text(encoding="utf-8")))


def settings_of(method: str) -> object:
    """What a method follows; raises `ValueError` for another one."""
    if method not in METHODS:
        raise ValueError(f"there is no method {method!r}; give some of {', '.join(METHODS)}")
    own = {"silhouettes": CodeFitConfig(), "stereo": None}
    return own.get(method, (method, _config(method), MOVED_BY))


def _config(method: str) -> PhotoConfig:
    """How a method looks at photographs."""
    return UNKNOWN_PLACE if "moved" in method else KNOWN_PLACE


def _found(trial: ClipTrial, model: Model, clip: dict[str, Any]) -> tuple[Float[Tensor, "length"], Similarity]:
    """The code, and the place."""
    prior, still, config = prior_of(model.codes), Similarity.identity(), _config(trial.method)
    views = list(load_photographs(trial.folder).views)
    if trial.method == "silhouettes":
        *_, step = fit_code(model.decoder, [_silhouette(trial.folder, view) for view in views], prior)
        return step.code, still
    if trial.method == "nearest":
        level = PyramidLevel.of(views, config.levels[0], config.comparison)
        best = Initialiser(model.decoder, prior).ranked(level, config.comparison, still)[0]
        return prior.code(best), still
    place = disturbed(hash_of(clip["shape"])) if config.comparison.fit_place else still
    *_, last = fit_photos(model.decoder, views, prior, config, place)
    return last.code, last.place


def disturbed(seed: int) -> Similarity:
    """A place that is off by `MOVED_BY`, to all sides alike."""
    random = torch.Generator().manual_seed(seed)
    axis, shift = torch.nn.functional.normalize(torch.randn(2, 3, generator=random), dim=-1)
    growth = torch.tensor([math.log1p(MOVED_BY[2])]) * (1 - 2 * torch.randint(2, (1,), generator=random))
    step = torch.cat([axis * math.radians(MOVED_BY[0]), shift * MOVED_BY[1], growth])
    return Similarity.identity().moved(step)


def _silhouette(folder: Path, view: Photograph) -> View:
    """The true mask of a frame, and nothing else."""
    mask = read_mask(folder / "truth" / "masks" / f"{view.name}.png")
    return View(view.camera, torch.full(mask.shape, torch.inf), mask)


def multiview_rows(results: Sequence[ClipResult]) -> list[dict[str, object]]:
    """Medians of each class, background and method."""
    groups = grouped(results, lambda each: (each.category, each.background, each.method))
    return [
        {
            "class": category,
            "background": background,
            "method": method,
            "chamfer_from_truth": median(each.chamfer_from for each in some),
            "chamfer": median(each.chamfer for each in some),
            "seconds": median(each.seconds for each in some),
            **({"recovered": sum(each.recovered for each in some) / len(some)} if "moved" in method else {}),
            "n": len(some),
        }
        for (category, background, method), some in groups.items()
    ]
