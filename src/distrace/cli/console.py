"""What all commands share: progress, devices, and the result that each leaves behind."""

import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from distrace.errors import DoubtfulResult, explained
from distrace.files import save_json

console = Console()
errors = Console(stderr=True, soft_wrap=True)
QUIET = 20.0  # seconds between lines where the output is no terminal


@dataclass
class Run:
    """One command at work: where it writes, since when, on what."""

    out: Path
    device: torch.device
    began: float = field(default_factory=time.perf_counter)
    warnings: list[str] = field(default_factory=list)  # sentences of DoubtfulResult

    @contextmanager
    def noticing(self) -> Iterator[None]:
        """Says each `DoubtfulResult` in one line on stderr, and keeps it. Other warnings are shown as ever."""
        with warnings.catch_warnings():
            warnings.simplefilter("always", DoubtfulResult)
            show = warnings.showwarning

            def notice(message: Warning | str, category: type[Warning], *where: Any) -> None:
                if not issubclass(category, DoubtfulResult):
                    show(message, category, *where)
                elif str(message) not in self.warnings:
                    self.warnings.append(str(message))
                    errors.print(f"distrace: warning: {message}", markup=False, highlight=False)

            warnings.showwarning = notice
            yield

    def finish(self, facts: dict[str, Any]) -> None:
        """Writes `result.json` and says where everything is."""
        common = {"seconds": round(time.perf_counter() - self.began, 3), "device": device_name(self.device)}
        if "evaluations" in facts:
            common["setup_evaluations"] = 0  # unless facts say otherwise
        save_json(self.out / "result.json", {**common, "version": version("distrace"), **facts})
        console.print(f"wrote [bold]{self.out}[/bold] in {common['seconds']:.1f} s")


def start(out: Path, device: str = "cpu") -> Run:
    """Makes the folder. Raises `ValueError` for an `--out` that is a file, or a device that is not there."""
    for path in (out, *out.parents):
        if path.exists() and not path.is_dir():
            raise ValueError(f"--out {out} cannot be a folder, for {path} is a file; give another to write to")
    out.mkdir(parents=True, exist_ok=True)
    return Run(out, chosen_device(device))


def chosen_device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(
            f"--device {name} was asked for, but this machine or this build of PyTorch has no CUDA; use cpu"
        )
    with explained(f"--device {name} is no device; use auto, cpu or cuda"):
        device = torch.device(name)
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"--device {name} is not supported; use auto, cpu or cuda")
    return device


def device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"cpu ({torch.get_num_threads()} threads)"


@contextmanager
def progress(description: str, total: int) -> Iterator["Bar"]:
    """A bar with the time left, and a few words that change as it goes on."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[words]}"),
    )
    with Progress(*columns, console=console) as bars:
        yield Bar(bars, bars.add_task(description, total=total, words=""))


@dataclass
class Bar:
    """A line of progress; where the output is no terminal, a line now and then."""

    bars: Progress
    task: TaskID
    said: float = field(default_factory=time.monotonic)

    def advance(self, words: str = "", to: int | None = None) -> None:
        if to is None:
            self.bars.update(self.task, advance=1, words=words)
        else:
            self.bars.update(self.task, completed=to, words=words)
        if not console.is_terminal and time.monotonic() - self.said > QUIET:
            task = self.bars.tasks[self.task]
            console.print(f"{task.description} {task.completed:.0f}/{task.total:.0f} {words}", markup=False)
            self.said = time.monotonic()


def machine() -> str:
    """Processor and library versions, for recorded tables."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown processor")
    return f"{name}, {torch.get_num_threads()} threads, PyTorch {torch.__version__}"


def origin() -> dict[str, str]:
    """What a recorded table was made by, and on."""
    return {"command": " ".join(sys.argv), "machine": machine()}
