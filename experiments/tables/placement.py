"""Completion from what a sensor gives: placement, surface and verdict, on scenes whose placement nobody tells."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from statistics import median

import numpy as np
import roma
import torch
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from distrace.data.scan import scan_of_view
from distrace.data.solid import Solid, normalised, normalised_frame
from distrace.data.up import Up
from distrace.files import save_json
from distrace.fitting.fit_scan import ScanFitConfig, fit_scan
from distrace.mesh import extract_mesh
from distrace.metrics import chamfer
from distrace.pose import Similarity
from distrace.prior import prior_of
from experiments.datasets.sensor import Scene, sensed
from experiments.datasets.solids import solid_of
from experiments.datasets.splits import shape_of
from experiments.procedural import procedural_mesh
from experiments.tables.sparse_depth import held_out
from experiments.tables.trials import Place, fingerprint, grouped, hash_of, network_once, read_json

INVENTED = "invented-"  # names of procedural shapes: this and a number
INVENTED_SEED = 500_000  # of the first; training used those from 0
DEGREES = 5.0
PERCENT = 5.0
SYMMETRY_STEP = 10  # degrees between the turns that are compared
SYMMETRIC = 0.6  # Chamfer × 1000 up to which a turned shape is the same
MEASURE = 2  # counts the definitions of the errors; files of earlier ones are computed again
USUAL_FACTOR = 2.0  # × the class's median Chamfer: up to there a completion is good


@dataclass(frozen=True)
class PlacedTrial:
    """A shape in a random scene; `told` says whether the fit knows its true placement."""

    category: str
    shape: str
    scene: int
    told: bool = False

    @property
    def file(self) -> str:
        return f"{self.category}/{self.shape}_{self.scene}{'_told' if self.told else ''}.json"

    @property
    def hidden(self) -> bool:
        """Half of the scenes are partly hidden."""
        return (hash_of(self.shape) + self.scene) % 2 == 1


@dataclass(frozen=True)
class Placed:
    """What a fit found."""

    trial: PlacedTrial
    degrees: float
    size_percent: float
    centre_percent: float  # of the object's diameter
    chamfer: float
    verdict: str
    explained: float
    blocked: float
    seen: float
    disagreement: float
    seconds: float
    evaluations: int

    @property
    def is_placed(self) -> bool:
        return self.degrees < DEGREES and self.size_percent < PERCENT and self.centre_percent < PERCENT

    def row(self) -> dict[str, object]:
        """Returns all fields, those of the trial included."""
        fields = asdict(self)
        fields = {**fields.pop("trial"), **fields, "placed": self.is_placed}
        return {key: round(value, 4) if isinstance(value, float) else value for key, value in fields.items()}


def placement_trials(categories: Sequence[str], shapes: int | None, invented: int, told: bool) -> list[PlacedTrial]:
    """Returns the trials of held-out shapes, and of procedural ones; each also with its placement told, if asked."""
    trials = []
    for category in categories:
        names = [shape.name for shape in held_out(category, shapes)]
        names += [f"{INVENTED}{number}" for number in range(invented)]
        trials += [PlacedTrial(category, name, 0) for name in names]
    return trials + [PlacedTrial(each.category, each.shape, each.scene, told=True) for each in trials if told]


def placed(place: Place, trial: PlacedTrial) -> Placed:
    """Returns a trial's result, read from the file of a run with the same model and settings, or computed and saved."""
    path = place.out / "trials" / trial.file
    model = place.model_of(trial.category)
    config = ScanFitConfig()
    network = network_once(dict(place.models)[trial.category])
    mark = fingerprint(model, place.resolution, config, MEASURE, network=network)
    if path.is_file():
        content = read_json(path)
        if content.pop("made_by", None) == mark:
            return Placed(PlacedTrial(**content.pop("trial")), **content)
    solid = true_solid(place.meshes, trial.category, trial.shape)
    scene = sensed(solid, hash_of(trial.shape) + trial.scene, trial.hidden)
    scan = scan_of_view(scene.view, scene.mask, Up.along("y"))
    known = scene.place if trial.told else None
    fit = fit_scan(model.decoder, scan, prior_of(model.codes), config, known, network=network)
    mesh = extract_mesh(place.field_of(trial.category, fit.code), place.mesh)
    found = by_extent(mesh, fit.place)
    degrees, size, centre = placement_error(found, scene.place, symmetric_turns(place.meshes, trial))
    result = Placed(
        trial,
        degrees,
        size,
        centre,
        chamfer(in_true_frame(mesh, fit.place, scene), solid.surface).sum,
        fit.verdict.name,
        fit.verdict.explained,
        fit.verdict.blocked,
        fit.verdict.seen,
        fit.verdict.disagreement,
        fit.seconds,
        fit.evaluations,
    )
    save_json(path, {"made_by": mark, **asdict(result)})
    return result


@lru_cache(maxsize=4)
def true_solid(meshes: Path, category: str, name: str) -> Solid:
    """Returns a held-out shape's solid, or a procedural one's."""
    if not name.startswith(INVENTED):
        return solid_of(shape_of(category, name), meshes)
    seed = INVENTED_SEED + int(name.removeprefix(INVENTED))
    mesh = normalised(procedural_mesh(category, np.random.default_rng(seed)))
    return Solid(mesh, mesh)


@lru_cache(maxsize=4)
def symmetric_turns(meshes: Path, trial: PlacedTrial) -> list[Float[Tensor, "3 3"]]:
    """Returns the rotations about y that leave a shape as it is."""
    surface = true_solid(meshes, trial.category, trial.shape).surface
    points = trimesh.sample.sample_surface(surface, 3000, seed=0)[0]
    tree = KDTree(trimesh.sample.sample_surface(surface, 20_000, seed=1)[0])
    turns = [turn_about_y(degrees) for degrees in range(0, 360, SYMMETRY_STEP)]
    apart = [1000 * float(np.square(tree.query(points @ turn.T.numpy())[0]).mean()) for turn in turns]
    return [turn for turn, distance in zip(turns, apart, strict=True) if distance < apart[0] + SYMMETRIC]


def turn_about_y(degrees: float) -> Float[Tensor, "3 3"]:
    return roma.rotvec_to_rotmat(torch.tensor([0.0, math.radians(degrees), 0.0]))


def placement_error(
    found: Similarity, true: Similarity, turns: Sequence[Float[Tensor, "3 3"]]
) -> tuple[float, float, float]:
    """Returns degrees, percent of the size, and the shift of the centre in percent of the diameter."""
    apart = [float(roma.rotmat_geodesic_distance(found.rotation, true.rotation @ turn)) for turn in turns]
    size = 100 * abs(float(found.scale / true.scale) - 1)
    centre = 100 * float((found.translation - true.translation).norm() / (2 * true.scale))
    return math.degrees(min(apart)), size, centre


def by_extent(mesh: trimesh.Trimesh, place: Similarity) -> Similarity:
    """Returns where an object is by its own extents, as those of true shapes: a code's may be less than the sphere."""
    middle, scale = normalised_frame(mesh)
    centre = place.to_world(torch.from_numpy(middle).float())
    return Similarity(place.rotation, centre, place.scale / float(scale))


def in_true_frame(mesh: trimesh.Trimesh, found: Similarity, scene: Scene) -> trimesh.Trimesh:
    """Returns a found mesh in the unit sphere of the true placement."""
    vertices = torch.from_numpy(np.asarray(mesh.vertices)).float()
    moved = scene.place.to_object(found.to_world(vertices)).numpy()
    return trimesh.Trimesh(moved, mesh.faces, process=False)


def placement_rows(results: Sequence[Placed]) -> list[dict[str, object]]:
    """Returns a row for each class and kind of shape."""
    unknown = [each for each in results if not each.trial.told]
    told = {(each.trial.category, each.trial.shape): each.chamfer for each in results if each.trial.told}
    rows = []
    groups = grouped(unknown, lambda each: (each.trial.category, each.trial.shape.startswith(INVENTED)))
    for (category, invented), group in groups.items():
        ratios = [each.chamfer / told[key] for each in group if (key := (category, each.trial.shape)) in told]
        rows.append(
            {
                "class": category,
                "shapes": "invented" if invented else "held out",
                "n": len(group),
                "placed": round(sum(each.is_placed for each in group) / len(group), 3),
                "degrees_median": round(median(each.degrees for each in group), 2),
                "size_percent_median": round(median(each.size_percent for each in group), 2),
                "centre_percent_median": round(median(each.centre_percent for each in group), 2),
                "chamfer_median": round(median(each.chamfer for each in group), 2),
                "chamfer_to_told_median": round(median(ratios), 2) if ratios else None,
                "seconds_median": round(median(each.seconds for each in group), 1),
            }
        )
    return rows


def verdict_rows(results: Sequence[Placed]) -> list[dict[str, object]]:
    """Returns, for each verdict, the share of completions within twice their class's median error."""
    unknown = [each for each in results if not each.trial.told]
    usual = {}
    for (category,), group in grouped(unknown, lambda each: (each.trial.category,)).items():
        usual[category] = median(each.chamfer for each in group)
    rows = []
    for (verdict,), group in sorted(grouped(unknown, lambda each: (each.verdict,)).items()):
        good = [each.chamfer <= USUAL_FACTOR * usual[each.trial.category] for each in group]
        placed = [each.is_placed for each in group]
        rows.append(
            {
                "verdict": verdict,
                "n": len(group),
                "within twice the usual error": round(sum(good) / len(group), 3),
                "placed": round(sum(placed) / len(group), 3),
            }
        )
    return rows
