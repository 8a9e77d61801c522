"""What several commands share: loading a model, and writing what was rendered."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
import tyro

from distrace import shading
from distrace.camera import Camera
from distrace.checkpoints.codes import model_source
from distrace.checkpoints.model import Model, load_model
from distrace.cli.console import Run, console
from distrace.files import save_arrays
from distrace.fitting.judge import Verdict
from distrace.mesh import save_mesh
from distrace.metrics import Chamfer
from distrace.render import Buffers
from distrace.report.page import short
from distrace.shading import Picture, Rgba

if TYPE_CHECKING:
    import trimesh

ModelName = Annotated[
    str,
    tyro.conf.arg(metavar="MODEL", help="a bundled model, a DeepSDF experiment folder, or a run of `train`"),
]
Views = Annotated[
    Path,
    tyro.conf.arg(
        metavar="VIEWS",
        help="a folder with views.json, transforms.json, cameras_sphere.npz, *_par.txt, or COLMAP's sparse/",
    ),
]
CodeName = Annotated[
    str, tyro.conf.arg(metavar="CODE", help="a training shape's number or name, or a code.npy that a command wrote")
]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Format = Literal["ply", "glb", "obj"]


def default(value: object, metavar: str | None = None) -> Any:
    """Annotates an option that is None unless given; `--help` shows what it then means."""
    return tyro.conf.arg(metavar=metavar or type(value).__name__.upper(), help_behavior_hint=f"(default: {value})")


Cluster = Annotated[str | None, default("this machine's cores", "auto|ADDRESS")]  # of Ray; it sees the same files
NONE = tyro.conf.arg(help_behavior_hint="(default: none)")  # of options that take any number of values


class Every:
    """A timer that says when to save. Raises `ValueError` for a time that never passes."""

    def __init__(self, seconds: float) -> None:
        if not seconds >= 0:
            raise ValueError(f"--save-every {seconds} was given; give seconds, at least 0")
        self.seconds = seconds
        self.last = time.perf_counter()

    def passed(self) -> bool:
        """Returns whether the time has passed; if so, starts again."""
        now = time.perf_counter()
        if now - self.last <= self.seconds:
            return False
        self.last = now
        return True


def opened(name: str, device: torch.device) -> Model:
    return load_model(name).to(device)


def opened_for(run: Run, name: str) -> Model:
    """Loads the model that a result is of; `result.json` says where it is."""
    model = opened(name, run.device)
    run.model = model_source(name)
    return model


def check_distance(distance: float | None) -> None:
    """Raises `ValueError` for a negative distance, which would put the camera behind the origin."""
    if distance is not None and distance < 0:
        raise ValueError(f"--distance {distance} was given; it cannot be negative")


@dataclass(frozen=True, kw_only=True)
class Orbit:
    """The options of a camera that looks at the origin."""

    azimuth: float = 30.0  # degrees
    elevation: float = 20.0  # degrees
    distance: float = 4.97  # from the camera to the origin, in radii of the unit sphere
    focal_mm: float = 60.0
    sensor_mm: float = 32.0
    size: int = 512  # pixels along each side

    def camera(self) -> Camera:
        """Returns the camera of the options. Raises `ValueError` where one is out of range."""
        check_distance(self.distance)
        return Camera.orbit(
            self.azimuth,
            self.elevation,
            self.distance,
            height=self.size,
            width=self.size,
            focal_mm=self.focal_mm,
            sensor_mm=self.sensor_mm,
        )


def save_pictures(folder: Path, buffers: Buffers, camera: Camera, shaded: Picture | Rgba, mask: Picture) -> None:
    pictures = {
        "depth": shading.depth_picture(buffers.depth),
        "normal": shading.normal_picture(buffers.normal, buffers.mask, camera.T_world_camera),
        "mask": mask,
        "shaded": shaded,
    }
    for name, image in pictures.items():
        shading.save_png(folder / f"{name}.png", image)


def save_buffers(path: Path, buffers: Buffers, clearance: bool) -> None:
    arrays = {name: getattr(buffers, name) for name in ("depth", "distance", "normal", "mask")}
    arrays |= {"evaluations": buffers.trace.evaluations, "outcome": buffers.trace.outcome}
    if clearance:
        arrays["clearance"] = buffers.clearance
    save_arrays(path, arrays)


def save_meshes(folder: Path, mesh: "trimesh.Trimesh", formats: Sequence[Format]) -> None:
    """Writes `mesh.ply`, `mesh.glb` or `mesh.obj`: one file for each format."""
    for kind in dict.fromkeys(formats):
        save_mesh(folder / f"mesh.{kind}", mesh)


def check_formats(formats: Sequence[Format]) -> None:
    """Raises `ValueError` where no format was given, so that no mesh would be written."""
    if not formats:
        raise ValueError("--format was given without a format; name ply, glb, obj, or several of them")


def finish_completion(run: Run, verdict: Verdict, loss: float, evaluations: int, distances: Chamfer | None) -> None:
    """Writes `result.json` of a completion, and prints its verdict and its distances from a true surface."""
    facts = {**verdict.facts(), "loss": loss, "evaluations": evaluations}
    lines = [f"{verdict.name}: {verdict.reason}"]
    if distances is not None:
        facts |= {"chamfer_to": distances.to, "chamfer_from": distances.from_, "chamfer": distances.sum}
        lines.append(f"Chamfer × 1000: {distances.to:.3f} to the true surface, {distances.from_:.3f} from it")
    run.finish(facts, *lines)


def show_table(rows: Sequence[Mapping[str, object]]) -> None:
    """Prints rows in full, however narrow the terminal is; a value that a row lacks stays empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns: list[list[str]] = []
    for name in names:
        column = [name, *(short(row.get(name, "")) for row in rows)]
        width = max(map(len, column))
        numeric = all(isinstance(row.get(name, 0), int | float) for row in rows)
        columns.append([cell.rjust(width) if numeric else cell.ljust(width) for cell in column])
    for number, line in enumerate(zip(*columns)):
        style = "" if number else "bold"
        console.print(" ".join(line).rstrip(), style=style, soft_wrap=True, highlight=False)
