"""Pieces of several commands: opening a model, and the files that a rendering leaves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import torch
import trimesh
import tyro
from rich.table import Table

from distrace import shading
from distrace.camera import Camera
from distrace.checkpoint import Model, load_model
from distrace.cli.console import console
from distrace.files import save_arrays, written
from distrace.render import Buffers
from distrace.report import View

ModelName = Annotated[str, tyro.conf.arg(metavar="MODEL")]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


def opened(name: str, device: torch.device) -> Model:
    return load_model(name).to(device)


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
    """Prints rows of the same keys; numbers in as few digits as tell."""
    shown = Table(*rows[0], padding=(0, 1, 0, 0), box=None)
    for row in rows:
        shown.add_row(*(_short(value) for value in row.values()))
    console.print(shown)


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.1e}" if 0 < abs(value) < 0.01 else f"{value:.5g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
