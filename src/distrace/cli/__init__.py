"""The command line. Each command writes to `--out`; an error is one line on stderr and exit status 2."""

import io
import os
import re
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any

import distrace
from distrace.imports import quickly
from distrace.optional import MissingLibrary


@dataclass(frozen=True)
class Lazy:
    """A command whose module is imported when it runs; `summary` is the first sentence of its docstring."""

    module: str
    name: str
    summary: str

    def loaded(self) -> type:
        """Returns the command."""
        return getattr(quickly(self.module), self.name)

    def listed(self) -> type:
        """Returns a command without options, for the list of commands."""
        return make_dataclass(self.name, (), namespace={"__doc__": self.summary})


Commands = Mapping[str, Lazy | type]

COMMANDS: Commands = {
    "demo": Lazy(
        "distrace.cli.complete", "Demo", "Complete the bundled sofa, held out of training, from 100 depths and a mask."
    ),
    "render": Lazy("distrace.cli.show", "Render", "Render one view: depth, normals, mask and a shaded picture."),
    "shapes": Lazy(
        "distrace.cli.shapes",
        "Shapes",
        "List the training shapes of a model by number and name; --thumbnails also draws them.",
    ),
    "mesh": Lazy("distrace.cli.show", "Mesh", "Extract a mesh by marching cubes."),
    "complete": Lazy(
        "distrace.cli.complete",
        "Complete",
        "Complete a shape from a depth image, an observation or a point cloud, wherever the object is.",
    ),
    "pose": Lazy("distrace.cli.pose", "Pose", "Find the camera of one view of a known shape."),
    "cameras": Lazy(
        "distrace.cli.cameras", "Cameras", "Find the cameras of photographs, or of a video, by structure from motion."
    ),
    "multiview": Lazy(
        "distrace.cli.multiview", "Multiview", "Find a shape and its placement from photographs with known cameras."
    ),
    "reconstruct": Lazy(
        "distrace.cli.reconstruct", "Reconstruct", "Reconstruct any object from photographs with known cameras."
    ),
    "view": Lazy(
        "distrace.cli.view", "ViewShape", "Show a shape in the browser: a model's, or what another command found."
    ),
    "data": Lazy("distrace.cli.data", "Data", "Fetch a source of meshes, and list each with its creator and licence."),
    "sample": Lazy("distrace.cli.data", "Sample", "Turn meshes into signed samples in DeepSDF's .npz."),
    "train": Lazy("distrace.cli.train", "Train", "Train a DeepSDF decoder and the codes of its shapes."),
    "bench": Lazy("distrace.cli.bench", "Bench", "Measure the tracer's cost and error against a cautious reference."),
    "check-gradients": Lazy(
        "distrace.cli.gradients", "CheckGradients", "Compare every derivative of an image with finite differences."
    ),
}

ABOUT = "Render neural signed distance functions, and fit them to observations. Results go to the folder --out."
INTERRUPTED = "interrupted"
# Options that a command's memory grows with:
GROWING = ("size", "sizes", "resolution", "samples", "rays", "width", "samples_per_step")
RESUMABLE = ("sample", "train", "cameras", "reconstruct")  # commands that continue when run again


def main() -> None:
    run_commands(COMMANDS, "distrace", ABOUT)


def run_commands(commands: Commands, program: str, about: str) -> None:
    """Runs what the command line says; exits the process where that fails."""
    sys.argv[0] = program  # as recorded tables name it
    _print_any_character()
    interrupted = INTERRUPTED
    try:
        with _leaving_at_interrupts(program):
            command = parsed(sys.argv[1:], commands, program, about)
        interrupted = f"{INTERRUPTED}; every written file is complete"
        if sys.argv[1] in RESUMABLE:
            interrupted += f", and {sys.argv[1]} continues when run again"
        with _without_empty_folders(getattr(command, "out", None)):
            command.run()
        sys.stdout.flush()
    except KeyboardInterrupt:
        _end(program, interrupted, 130)
    except BrokenPipeError:
        discard_output()
    except (ValueError, OSError, MissingLibrary) as error:
        _end(program, str(error), 2)
    except (MemoryError, RuntimeError) as error:
        if not _out_of_memory(error):
            raise
        _end(program, f"not enough memory{_sizes(command)}; use a smaller size, or another device", 2)


def parsed(arguments: list[str], commands: Commands = COMMANDS, program: str = "distrace", about: str = ABOUT) -> Any:
    """Returns the command with its options. Raises `ValueError` for arguments that cannot be parsed."""
    import tyro

    if arguments == ["--version"]:
        print(program, distrace.__version__, flush=True)
        sys.exit()
    message = io.StringIO()
    try:
        with redirect_stderr(message):
            if arguments and arguments[0] in commands:
                name, *options = arguments
                chosen = commands[name]
                kind = chosen.loaded() if isinstance(chosen, Lazy) else chosen
                command = tyro.cli(kind, args=options, prog=f"{program} {name}")
            else:
                kinds = {name: each.listed() if isinstance(each, Lazy) else each for name, each in commands.items()}
                command = tyro.extras.subcommand_cli_from_dict(kinds, args=arguments, prog=program, description=about)
    except SystemExit as stop:
        if stop.code:
            raise ValueError(_one_line(message.getvalue())) from None
        sys.stdout.flush()
        raise
    seed = getattr(command, "seed", None)
    if seed is not None and not 0 <= seed < 2**31:
        raise ValueError(f"--seed {seed} was given; a number from 0 to {2**31 - 1} is needed")
    return command


@contextmanager
def _without_empty_folders(out: Path | None) -> Iterator[None]:
    """Where a command fails, removes the folders on the way to `out` that it made, if it wrote nothing there."""
    made = [] if out is None else [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        yield
    except BaseException:
        for folder in made:
            with suppress(OSError):  # it holds something, or was not made
                folder.rmdir()
        raise


def discard_output() -> None:
    """Sends what is still printed nowhere, for the process that read it is gone."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _leaving_at_interrupts(program: str) -> Iterator[None]:
    """Ctrl-C ends the process at once: an exception can be lost in libraries that are being imported."""

    def leave(*_: object) -> None:
        os.write(2, f"{program}: {INTERRUPTED}\n".encode())
        os._exit(130)

    handler = signal.getsignal(signal.SIGINT)
    if handler is not signal.default_int_handler or current_thread() is not main_thread():
        yield
        return
    signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _print_any_character() -> None:
    """Replaces characters that the output's encoding lacks, instead of failing at them."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def _out_of_memory(error: Exception) -> bool:
    import torch

    return isinstance(error, MemoryError | torch.OutOfMemoryError) or "allocate memory" in str(error)


def _sizes(command: Any) -> str:
    """Returns the options that a command's memory grows with, and their values."""
    given: list[str] = []
    for name in GROWING:
        value = getattr(command, name, ())
        numbers = value if isinstance(value, tuple) else (value,)
        if numbers and all(isinstance(number, int) for number in numbers):
            given.append(f"--{name.replace('_', '-')} {' '.join(map(str, numbers))}")
    return f" for {' '.join(given)}" if given else ""


def _one_line(box: str) -> str:
    """The parser's message without the box that it draws around it, and without its title, which the rest repeats."""
    title, _, content = box.strip().partition("\n")
    text = re.sub(r"\x1b\[[0-9;]*m|[\u2500-\u257f]|-{4,}", " ", content or title)
    text = " ".join(text.split()).replace("invalid choice", "Invalid choice", 1)
    text = re.sub(r"no type matching .*(?= Argument helptext)", "another value was given", text)  # than lists of types
    text = re.sub(r"'None', |, 'None'", "", text)  # of an option that is left out
    text = text.replace(" Argument helptext:", "; expected").replace(" Available subcommands:", "; expected one of")
    return re.sub(r"[ .]*For full helptext, (run|see):?", "; see", text)


def _end(program: str, sentence: str, status: int) -> None:
    print(f"{program}: {' '.join(sentence.split())}", file=sys.stderr)
    sys.exit(status)
