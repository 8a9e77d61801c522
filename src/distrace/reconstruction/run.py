"""A reconstruction on disk: everything needed to go on as if it had not been stopped, in one file."""

import operator
import zlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from distrace.data.photograph import Photograph
from distrace.errors import explained
from distrace.files import written
from distrace.reconstruction.reconstruct import ReconstructConfig, Reconstruction
from distrace.reconstruction.surface_network import SurfaceSpecs

NAME = "checkpoint.pt"


def mark(photograph: Photograph) -> str:
    """Its name, and what tells its pixels, mask and camera from others."""
    camera = torch.cat([photograph.camera.intrinsics.flatten(), photograph.camera.T_world_camera.flatten()])
    parts = ((255 * photograph.image).round().byte(), photograph.known_mask, (1e4 * camera.double()).round().long())
    digest = 0
    for part in parts:
        digest = zlib.crc32(part.contiguous().numpy().tobytes(), digest)
    return f"{photograph.name} {digest:08x}"


def save_reconstruction(folder: Path, state: Reconstruction, config: ReconstructConfig, marks: Sequence[str]) -> None:
    """Replaces the run's checkpoint; at no moment is there none. `marks` are those of the photographs."""
    content = {
        "specs": asdict(state.surface.specs),
        "config": asdict(config),
        "marks": list(marks),
        "step": state.step,
        "seconds": state.seconds,
        "evaluations": state.evaluations,
        "course": state.course,
        "surface": state.surface.state_dict(),
        "colour": state.colour.state_dict(),
        "steps_of_views": state.steps_of_views.detach(),
        "optimiser": state.optimiser.state_dict(),
    }
    with written(folder / NAME) as file:
        torch.save(content, file)


def load_reconstruction(
    folder: Path, config: ReconstructConfig, specs: SurfaceSpecs, marks: Sequence[str], device: torch.device
) -> Reconstruction:
    """The run as it was last saved, or a fresh one where there is none.

    Raises `ValueError` for a damaged checkpoint, or one of other photographs or settings.
    """
    state, path = Reconstruction.fresh(specs, config, len(marks), device), folder / NAME
    if not path.exists():
        return state
    with explained(f"{path} is not a checkpoint of a reconstruction; move it away to start afresh"):
        kept = torch.load(path, map_location=device, weights_only=True)
        before = {name: tuple(value) if isinstance(value, list) else value for name, value in kept["config"].items()}
        others = _changes({"photographs": kept.get("marks"), **before, **kept["specs"]}, marks, config, specs)
        if not others:
            state.surface.load_state_dict(kept["surface"])
            state.colour.load_state_dict(kept["colour"])
            state.steps_of_views.data.copy_(kept["steps_of_views"])
            state.optimiser.load_state_dict(kept["optimiser"])
            state.step = operator.index(kept["step"])
            state.seconds = float(kept["seconds"])
            state.evaluations = operator.index(kept["evaluations"])
            state.course = {str(name): [float(value) for value in values] for name, values in kept["course"].items()}
    if others:
        raise ValueError(f"{path} is of a run with other {', '.join(others)}; give the same, or another --out")
    return state


def _changes(
    before: dict[str, object], marks: Sequence[str], config: ReconstructConfig, specs: SurfaceSpecs
) -> list[str]:
    now = {"photographs": list(marks), **asdict(config), **asdict(specs)}
    return [name for name, value in now.items() if before.get(name) != value]
