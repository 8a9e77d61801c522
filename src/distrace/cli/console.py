"""What all commands share: progress, devices, and the result that each writes."""

import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
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

import distrace
from distrace.cli import discard_output
from distrace.errors import DoubtfulResult, error_context
from distrace.files import file_in_the_way, save_json
from distrace.optional import MissingLibrary

QUIET = 20.0  # seconds between lines where the output is no terminal


class Output(Console):
    """The standard output. Text is printed as it is: names of files may look like markup."""

    def __init__(self) -> None:
        super().__init__(markup=False, emoji=False)

    def on_broken_pipe(self) -> None:
        """Goes on without printing: the command still writes its files."""
        self.quiet = True
        discard_output()


console = Output()


@dataclass
class Run:
    """One command at work: its folder, its device and its start."""

    out: Path
    device: torch.device
    began: float = field(default_factory=time.perf_counter)
    warnings: list[str] = field(default_factory=list)  # sentences
    model: str | None = None  # that the result is of, so that other commands can load it

    @property
    def origin(self) -> str:
        """The line of a page that says what made it."""
        model = [] if self.model is None else [f"model {self.model}"]
        return " · ".join([*model, " ".join(sys.argv), f"distrace {distrace.__version__}"])

    def warn(self, sentence: str) -> None:
        """Prints a sentence on stderr, once, and keeps it for `result.json`."""
        if sentence not in self.warnings:
            self.warnings.append(sentence)
            print(f"distrace: warning: {sentence}", file=sys.stderr)

    @contextmanager
    def noticing(self) -> Iterator[None]:
        """Warns of each `DoubtfulResult` in one line. Other warnings are shown as usual."""
        with warnings.catch_warnings():
            warnings.simplefilter("always", DoubtfulResult)
            show = warnings.showwarning

            def notice(message: Warning | str, category: type[Warning], *where: Any) -> None:
                if issubclass(category, DoubtfulResult):
                    self.warn(str(message))
                else:
                    show(message, category, *where)

            warnings.showwarning = notice
            yield

    @contextmanager
    def optional(self, name: str) -> Iterator[None]:
        """Lets a command finish without a file whose library is not installed; a warning says so."""
        try:
            yield
        except MissingLibrary as error:
            self.warn(f"{name} is left out: {error}")

    def finish(self, facts: dict[str, Any], *lines: str) -> None:
        """Writes `result.json`, then prints lines and the folder."""
        content: dict[str, Any] = {
            "seconds": round(time.perf_counter() - self.began, 3),
            "device": device_name(self.device),
            "version": distrace.__version__,
            "command": " ".join(sys.argv),
            "machine": machine(),
            "warnings": self.warnings,
        }
        if "evaluations" in facts:
            content["setup_evaluations"] = 0  # unless facts say otherwise
        if self.model is not None:
            content["model"] = self.model
        save_json(self.out / "result.json", content | facts)
        for line in lines:
            console.print(line)
        console.print(f"wrote {self.out} in {content['seconds']:.1f} s", soft_wrap=True)


def start(out: Path, device: str = "cpu") -> Run:
    """Makes the folder. Raises `ValueError` for an `--out` that is a file, or an unavailable device."""
    file = file_in_the_way(out)
    if file is not None:
        raise ValueError(f"--out {out} cannot be a folder, for {file} is a file; give another to write to")
    out.mkdir(parents=True, exist_ok=True)
    return Run(out, chosen_device(device))


def chosen_device(name: str) -> torch.device:
    """Returns the device of a name; `auto` is CUDA where there is one. Raises `ValueError` for any other device."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"--device {name} was given, but this machine or this build of PyTorch has no CUDA; use cpu")
    with error_context(f"--device {name} is no device; use auto, cpu or cuda"):
        device = torch.device(name)
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"--device {name} is not supported; use auto, cpu or cuda")
    return device


def device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"cpu ({torch.get_num_threads()} threads)"


@contextmanager
def progress(description: str, total: int) -> Iterator["Bar"]:
    """A bar with the remaining time, and a few words that change with each step. It is full at the end."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[words]}", markup=False),
    )
    with Progress(*columns, console=console) as bars:
        bar = Bar(bars, bars.add_task(description, total=total, words=""))
        yield bar
        bar.finish()


@dataclass
class Bar:
    """A bar of progress in a terminal; elsewhere a line every `QUIET` seconds."""

    bars: Progress
    task: TaskID
    printed: float = field(default_factory=time.monotonic)

    def advance(self, words: str = "", to: int | None = None) -> None:
        """Moves the bar by one step, or to a step."""
        if to is None:
            self.bars.update(self.task, advance=1, words=words)
        else:
            self.bars.update(self.task, completed=to, words=words)
        if not console.is_terminal and time.monotonic() - self.printed > QUIET:
            task = self.bars.tasks[self.task]
            console.print(f"{task.description} {task.completed:.0f}/{task.total:.0f} {words}")
            self.printed = time.monotonic()

    def finish(self) -> None:
        """Makes the bar full where fewer steps than expected were needed."""
        self.bars.update(self.task, total=self.bars.tasks[self.task].completed or None)


def machine() -> str:
    """Returns the processor and PyTorch's version."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown processor")
    return f"{name}, {torch.get_num_threads()} threads, PyTorch {torch.__version__}"
