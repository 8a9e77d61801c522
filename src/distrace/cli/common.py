"""Pieces of several commands: opening a model, and the files that a rendering leaves."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
import trimesh
import tyro

from distrace import shading
from distrace.camera import Camera
from distrace.checkpoints.model import Model, load_model
from distrace.cli.console import console
from distrace.files import save_arrays, written
from distrace.render import Buffers
from distrace.report.completion_page import View
from distrace.report.page import short

ModelName = Annotated[str, tyro.conf.arg(metavar="MODEL")]
Views = Annotated[
    Path,
    tyro.conf.arg(
        metavar="VIEWS",
        help="a folder with views.json, transforms.json, cameras_sphere.npz, *_par.txt, or COLMAP's sparse/",
    ),
]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


class Every:
    """Tells when it is time to save: seconds since it last did. Raises `ValueError` for a time that never passes."""

    def __init__(self, seconds: float) -> None:
        if not seconds >= 0:
            raise ValueError(f"--save-every {seconds} was given; give seconds, at least 0")
        self.seconds, self.last = seconds, time.perf_counter()

    def passed(self) -> bool:
        """Whether they have; if so, they count anew."""
        over = time.perf_counter() - self.last > self.seconds
        self.last = time.perf_counter() if over else self.last
        return over


def opened(name: str, device: torch.device) -> Model:
    return load_model(name).to(device)


def orbiting(view: Any) -> Camera:
    """The camera that a command's own words put around the shape."""
    return Camera.orbit(
        view.azimuth,
        view.elevation,
        view.distance,
        focal_mm=view.focal_mm,
        sensor_mm=view.sensor_mm,
        height=view.size,
        width=view.size,
    )


def save_pictures(folder: Path, buffers: Buffers, camera: Camera) -> None:
    pictures = {
        "depth": shading.depth_picture(buffers.depth),
        "normal": shading.normal_picture(buffers.normal, buffers.mask, camera.T_world_camera),
        "mask": shading.mask_picture(buffers.mask),
        "shaded": View.of(buffers).shaded,
    }
    for name, image in pictures.items():
        shading.save_png(folder / f"{name}.png", image)


def save_buffers(path: Path, buffers: Buffers, clearance: bool) -> None:
    arrays = {name: getattr(buffers, name) for name in ("depth", "distance", "normal", "mask")}
    arrays |= {"evaluations": buffers.trace.evaluations, "outcome": buffers.trace.outcome}
    if clearance:
        arrays["clearance"] = buffers.clearance
    save_arrays(path, arrays)


def save_mesh(path: Path, mesh: trimesh.Trimesh) -> None:
    with written(path) as file:
        mesh.export(file, file_type="ply")


def show_table(rows: Sequence[Mapping[str, object]]) -> None:
    """Prints rows in full, however narrow the terminal is; what a row has not stays empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns: list[list[str]] = []
    for name in names:
        column = [name, *(short(row.get(name, "")) for row in rows)]
        width = max(map(len, column))
        numeric = all(isinstance(row.get(name, 0), int | float) for row in rows)
        columns.append([cell.rjust(width) if numeric else cell.ljust(width) for cell in column])
    for number, line in enumerate(zip(*columns)):
        style = "" if number else "bold"
        console.print(" ".join(line).rstrip(), style=style, soft_wrap=True, markup=False, highlight=False)
