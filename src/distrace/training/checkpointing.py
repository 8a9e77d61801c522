"""The checkpoint of a training run: one file, from which a resumed run ends like an uninterrupted one."""

import math
import operator
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from distrace.errors import error_context
from distrace.fields.decoder import NetworkSpecs
from distrace.files import atomic_write
from distrace.training.config import TrainConfig
from distrace.training.distributed import Processes
from distrace.training.losses import STEPS_PER_LOSS
from distrace.training.trainer import Training, adam, start_training

NAME = "checkpoint.pt"


def save_training(folder: Path, training: Training, config: TrainConfig, names: list[str]) -> None:
    """Replaces the run's checkpoint in one step."""
    state = {
        "step": training.step,
        "losses": training.losses,
        "config": asdict(config),
        "specs": asdict(training.decoder.specs),
        "names": names,
        "decoder": training.decoder.state_dict(),
        "codes": training.codes.detach(),
        "optimiser": training.optimiser.state_dict(),
    }
    with atomic_write(folder / NAME) as file:
        torch.save(state, file)


def sharded(training: Training, processes: Processes) -> Training:
    """The run with the codes of this process's shapes alone."""
    return training if processes.size == 1 else _with_codes(training, processes.part)


def gathered(training: Training, processes: Processes, shapes: int) -> Training:
    """The run with the codes of all shapes, from what each process has; all processes must call it."""
    if processes.size == 1:
        return training
    return _with_codes(training, lambda rows: processes.gathered(rows, shapes))


def _with_codes(training: Training, change: Callable[[Tensor], Tensor]) -> Training:
    """The run with other codes: `change` is applied to them and to their moments in the optimiser."""
    codes = nn.Parameter(change(training.codes.detach()))
    stored = training.optimiser.state_dict()
    (number,) = stored["param_groups"][-1]["params"]
    moments = stored["state"].get(number, {})  # none before the first step
    changed = {name: change(value) if value.dim() else value for name, value in moments.items()}
    optimiser = adam(training.decoder, codes)
    optimiser.load_state_dict(stored | {"state": stored["state"] | ({number: changed} if moments else {})})
    return replace(training, codes=codes, optimiser=optimiser)


def load_training(folder: Path, names: list[str], device: torch.device) -> tuple[Training, TrainConfig] | None:
    """The run as it was last saved, with its own configuration; None where there is none.

    Raises `ValueError` for a damaged checkpoint, or one of other shapes.
    """
    path = folder / NAME
    if not path.exists():
        return None
    with error_context(f"{path} is not a checkpoint of a training run; move it away to start afresh"):
        state = torch.load(path, map_location=device, weights_only=True)
        config = TrainConfig(**state["config"])
        specs = NetworkSpecs(**state["specs"])
        training = start_training(len(state["names"]), specs, config, device)
        training.decoder.load_state_dict(state["decoder"])
        training.codes.data.copy_(state["codes"])
        training.optimiser.load_state_dict(state["optimiser"])
        training.step = operator.index(state["step"])
        unknown = [math.nan] * -(-training.step // STEPS_PER_LOSS)  # of runs begun before losses were kept
        training.losses = [float(loss) for loss in state.get("losses", unknown)]
    if state["names"] != names:
        raise ValueError(
            f"{path} was trained on {len(state['names'])} files of samples, and now there are {len(names)} or others;"
            " give another --out to start afresh"
        )
    return training, config
