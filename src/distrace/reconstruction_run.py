"""A reconstruction on disk: everything needed to go on as if it had not been stopped, in one file."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from distrace.errors import explained
from distrace.files import written
from distrace.reconstruct import ReconstructConfig, Reconstruction
from distrace.surface_network import SurfaceSpecs

NAME = "checkpoint.pt"


def save_reconstruction(folder: Path, state: Reconstruction, config: ReconstructConfig, names: Sequence[str]) -> None:
    """Replaces the run's checkpoint; at no moment is there none. `names` are those of the photographs."""
    content = {
        "specs": asdict(state.surface.specs),
        "config": asdict(config),
        "names": list(names),
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
    folder: Path, config: ReconstructConfig, specs: SurfaceSpecs, names: Sequence[str], device: torch.device
) -> Reconstruction:
    """The run as it was last saved, or a fresh one where there is none.

    Raises `ValueError` for a damaged checkpoint, or one of other photographs or settings.
    """
    state, path = Reconstruction.fresh(specs, config, len(names), device), folder / NAME
    if not path.exists():
        return state
    with explained(f"{path} is not a checkpoint of a reconstruction; move it away to start afresh"):
        kept = torch.load(path, map_location=device, weights_only=True)
        before = {name: tuple(value) if isinstance(value, list) else value for name, value in kept["config"].items()}
        others = _changes({"photographs": kept["names"], **before, **kept["specs"]}, names, config, specs)
        if not others:
            state.surface.load_state_dict(kept["surface"])
            state.colour.load_state_dict(kept["colour"])
            state.steps_of_views.data.copy_(kept["steps_of_views"])
            state.optimiser.load_state_dict(kept["optimiser"])
            for name in ("step", "seconds", "evaluations", "course"):
                setattr(state, name, kept[name])
    if others:
        raise ValueError(f"{path} is of a run with other {', '.join(others)}; give the same, or another --out")
    return state


def _changes(
    before: dict[str, object], names: Sequence[str], config: ReconstructConfig, specs: SurfaceSpecs
) -> list[str]:
    now = {"photographs": list(names), **asdict(config), **asdict(specs)}
    return [name for name, value in now.items() if before.get(name) != value]
