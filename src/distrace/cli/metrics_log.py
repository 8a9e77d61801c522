"""How a run goes: `metrics.jsonl`, a JSON object a line; `--log tensorboard` also writes event files."""

import json
import math
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal

from distrace.files import save_text
from distrace.optional import require
from distrace.training.losses import STEPS_PER_LOSS

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

NAME = "metrics.jsonl"
Log = Literal["none", "tensorboard"]


class MetricsLog:
    """Appends numbers to a run's `metrics.jsonl`, every `STEPS_PER_LOSS` steps and after the last.

    A resumed run goes on after the lines up to its `step`, and counts seconds from there; later lines are removed.
    """

    def __init__(self, folder: Path, step: int, log: Log = "none") -> None:
        self.writer = _event_writer(folder / "tensorboard", step) if log == "tensorboard" else None
        lines = _lines_up_to(folder / NAME, step)
        save_text(folder / NAME, "".join(f"{json.dumps(line)}\n" for line in lines))
        self.file = (folder / NAME).open("a", encoding="utf-8")
        self.began = time.perf_counter() - (lines[-1]["seconds"] if lines else 0.0)

    def __enter__(self) -> "MetricsLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.file.close()
        if self.writer is not None:
            self.writer.close()

    def write(self, step: int, values: dict[str, float]) -> None:
        """Writes numbers of a step, each a mean over the steps since the last line where it is a loss."""
        seconds = round(time.perf_counter() - self.began, 3)
        finite = {name: value if math.isfinite(value) else None for name, value in values.items()}  # JSON has no NaN
        self.file.write(json.dumps({"step": step, "seconds": seconds, **finite}) + "\n")
        self.file.flush()
        if self.writer is not None:
            for name, value in values.items():
                self.writer.add_scalar(name, value, step)
            self.writer.flush()


def is_due(step: int, *ends: int) -> bool:
    """Returns whether a line is due after a step; `ends` are the last steps of the run and of its parts."""
    return step % STEPS_PER_LOSS == 0 or step in ends


def check_log(log: Log) -> None:
    """Raises `MissingLibrary` where the log needs a library that is not installed."""
    if log == "tensorboard":
        require("--log tensorboard", "tensorboard")


def _event_writer(folder: Path, step: int) -> "SummaryWriter":
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step + 1)  # hides the steps that a resumed run repeats


def _lines_up_to(path: Path, step: int) -> list[dict[str, float]]:
    """Returns the lines up to a step; a line that was cut off is left out."""
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            line = json.loads(text)
            if line["step"] <= step and line["seconds"] >= 0:
                lines.append(line)
        except (ValueError, TypeError, KeyError):
            continue
    return lines
