"""Held-out shapes from clips without depth or masks, against true masks, training shapes, and classical stereo.

The protocol is DIST's (Liu et al., CVPR 2020, section 4.3): the cameras are given, and the code is fitted. A second
method starts from a disturbed placement.
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
from distrace.errors import error_context
from distrace.files import atomic_write, save_json
from distrace.fitting.fit_code import CodeFitConfig, fit_code
from distrace.mesh import MeshConfig, extract_mesh, mesh_in_world
from distrace.metrics import chamfer, surface_points
from distrace.photos.fit_photos import KNOWN_PLACE, UNKNOWN_PLACE, PhotoConfig, fit_photos
from distrace.photos.initialisation import Initialiser
from distrace.photos.photo_set import PhotoSet
from distrace.pose import Similarity
from distrace.prior import prior_of
from experiments.baselines.semi_global import stereo_points
from experiments.tables.sparse_depth import true_solid
from experiments.tables.trials import fingerprint, grouped, hash_of, opened_once, read_json

METHODS = ("nearest", "silhouettes", "stereo", "ours", "ours, moved")
MOVED_BY = (10.0, 0.1, 0.1)  # degrees, radii, and part of the size
RECOVERED = (2.0, 0.02, 0.02)  # a fifth of that: errors up to which the placement counts as found
REGISTERED = 10_000  # points of each surface, for the registration
RESOLUTION = 192

Surface = trimesh.Trimesh | np.ndarray  # a mesh or points


@dataclass(frozen=True)
class ClipTrial:
    """A clip made by `python -m experiments clip`, and the method that fits it."""

    folder: Path
    method: str
    meshes: Path
    out: Path
    model: str | None = None  # by default the one of the clip's split

    def file(self, suffix: str) -> Path:
        """Returns the path of the trial's figures (.json) or surface (.ply)."""
        clip = described(self.folder)
        name = "_".join((clip["shape"], clip["background"], clip["texture"], self.method))
        return self.out / "trials" / f"{name}{suffix}"


@dataclass(frozen=True)
class ClipResult:
    """The distance of the fitted surface from the true one, in the world, and the motion that aligns them best."""

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
    code: list[float]  # empty for stereo

    @property
    def chamfer(self) -> float:
        return self.chamfer_to + self.chamfer_from

    @property
    def recovered(self) -> bool:
        return all(off <= limit for off, limit in zip((self.degrees, self.shift, self.growth), RECOVERED, strict=True))

    def row(self) -> dict[str, object]:
        """Returns all fields but the code."""
        return {name: value for name, value in asdict(self).items() if name != "code"}


def clip_done(trial: ClipTrial) -> ClipResult:
    """Returns a trial's result, read from the file of a run with the same model and settings, or computed and saved."""
    clip = described(trial.folder)
    model = opened_once(trial.model or clip["split"])
    mark = fingerprint(model, tuple(sorted(clip.items())), settings_of(trial.method))
    if trial.file(".json").is_file() and trial.file(".ply").is_file():
        content = read_json(trial.file(".json"))
        if content.pop("made_by", None) == mark:
            return ClipResult(**content)
    start = time.perf_counter()
    code = torch.zeros(0)
    if trial.method == "stereo":
        surface: Surface = stereo_points(load_photographs(trial.folder).views)
        seconds = time.perf_counter() - start
    else:
        code, place = _fitted(trial, model, clip)
        seconds = time.perf_counter() - start
        surface = mesh_in_world(extract_mesh(model.field(code), MeshConfig(RESOLUTION)), place)
    true = true_solid(trial.meshes, clip["split"], clip["shape"]).surface
    distance = chamfer(surface, true)
    motion = remaining_motion(surface, true)
    names = clip["split"], clip["shape"], clip["background"], clip["texture"], trial.method
    result = ClipResult(*names, distance.to, distance.from_, seconds, *motion, [round(x, 6) for x in code.tolist()])
    with atomic_write(trial.file(".ply")) as file:
        (trimesh.PointCloud(surface) if isinstance(surface, np.ndarray) else surface).export(file, file_type="ply")
    save_json(trial.file(".json"), {"made_by": mark, **asdict(result)})
    return result


def surface_of(trial: ClipTrial) -> Surface:
    """Returns the surface of a finished trial."""
    surface: Any = trimesh.load(trial.file(".ply"), process=False)
    return surface if isinstance(surface, trimesh.Trimesh) else np.asarray(surface.vertices)


def remaining_motion(surface: Surface, true: trimesh.Trimesh) -> tuple[float, float, float]:
    """Returns the similarity that aligns a surface by iterative closest points: degrees, radii, and share of its size.

    Code and placement can compensate each other in size, so neither is right or wrong alone.
    """
    points = surface if isinstance(surface, np.ndarray) else surface_points(surface, REGISTERED, seed=0)
    target = surface_points(true, REGISTERED, seed=1)
    options = {"threshold": 1e-9, "max_iterations": 100, "reflection": False}
    matrix = torch.from_numpy(trimesh.registration.icp(points, target, **options)[0]).float()
    scale = matrix[:3, :3].det().abs() ** (1 / 3)
    step = Similarity(matrix[:3, :3] / scale, matrix[:3, 3], scale).step_from(Similarity.identity())
    return math.degrees(float(step[:3].norm())), float(step[3:6].norm()), abs(math.expm1(float(step[6])))


def described(folder: Path) -> dict[str, Any]:
    """Returns `clip.json`. Raises `ValueError` for a folder without one."""
    path = folder / "clip.json"
    with error_context(f"{path} is no description of a clip; `python -m experiments clip SHAPE` makes one"):
        return dict(json.loads(path.read_text(encoding="utf-8")))


def settings_of(method: str) -> object:
    """Returns the settings of a method. Raises `ValueError` for an unknown one."""
    if method not in METHODS:
        raise ValueError(f"there is no method {method!r}; choose from {', '.join(METHODS)}")
    by_method = {"silhouettes": CodeFitConfig(), "stereo": None}
    return by_method.get(method, (method, _config(method), MOVED_BY))


def _config(method: str) -> PhotoConfig:
    """Returns the configuration of a method that uses photographs."""
    return UNKNOWN_PLACE if "moved" in method else KNOWN_PLACE


def _fitted(trial: ClipTrial, model: Model, clip: dict[str, Any]) -> tuple[Float[Tensor, "length"], Similarity]:
    """Returns the code and the placement."""
    prior = prior_of(model.codes)
    identity = Similarity.identity()
    config = _config(trial.method)
    views = list(load_photographs(trial.folder).views)
    if trial.method == "silhouettes":
        fit = fit_code(model.decoder, [_silhouette(trial.folder, view) for view in views], prior)
        return fit.code, identity
    if trial.method == "nearest":
        coarse = PhotoSet(model.decoder, [view.resized(0.5) for view in views], prior, config.comparison)
        best = Initialiser(coarse).ranked(identity)[0]
        return prior.code(best), identity
    place = disturbed(hash_of(clip["shape"])) if config.comparison.fit_place else identity
    last = fit_photos(model.decoder, views, prior, config, place).last
    return last.code, last.place


def disturbed(seed: int) -> Similarity:
    """Returns a placement that is off by `MOVED_BY`, in a random direction."""
    random = torch.Generator().manual_seed(seed)
    axis, shift = torch.nn.functional.normalize(torch.randn(2, 3, generator=random), dim=-1)
    growth = torch.tensor([math.log1p(MOVED_BY[2])]) * (1 - 2 * torch.randint(2, (1,), generator=random))
    step = torch.cat([axis * math.radians(MOVED_BY[0]), shift * MOVED_BY[1], growth])
    return Similarity.identity().moved(step)


def _silhouette(folder: Path, view: Photograph) -> View:
    """Returns the true mask of a frame as an observation."""
    mask = read_mask(folder / "truth" / "masks" / f"{view.name}.png")
    return View(view.camera, torch.full(mask.shape, torch.inf), mask)


def multiview_rows(results: Sequence[ClipResult]) -> list[dict[str, object]]:
    """Returns medians of each class, background and method."""
    groups = grouped(results, lambda each: (each.category, each.background, each.method))
    return [
        {
            "class": category,
            "background": background,
            "method": method,
            "chamfer_from_truth": median(each.chamfer_from for each in group),
            "chamfer": median(each.chamfer for each in group),
            "seconds": median(each.seconds for each in group),
            **({"recovered": sum(each.recovered for each in group) / len(group)} if "moved" in method else {}),
            "n": len(group),
        }
        for (category, background, method), group in groups.items()
    ]
