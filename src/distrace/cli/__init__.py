"""The command line. Each command writes to `--out`; whatever goes wrong is one line on stderr and exit status 2."""

import io
import re
import sys
from collections.abc import Mapping
from contextlib import redirect_stderr

import torch
import tyro

from distrace.cli.bench import Bench
from distrace.cli.complete import Complete, Demo
from distrace.cli.console import errors
from distrace.cli.data import Data, Sample
from distrace.cli.gradients import CheckGradients
from distrace.cli.multiview import Multiview
from distrace.cli.pose import Pose
from distrace.cli.reconstruct import Reconstruct
from distrace.cli.show import Mesh, Render
from distrace.cli.train import Train

COMMANDS = {
    "demo": Demo,
    "render": Render,
    "mesh": Mesh,
    "complete": Complete,
    "pose": Pose,
    "multiview": Multiview,
    "reconstruct": Reconstruct,
    "data": Data,
    "sample": Sample,
    "train": Train,
    "bench": Bench,
    "check-gradients": CheckGradients,
}

ABOUT = "Render neural signed distance functions, and fit them to what was observed. Results go to the folder --out."


def main() -> None:
    run_commands(COMMANDS, "distrace", ABOUT)


def run_commands(commands: Mapping[str, type], program: str, about: str) -> None:
    """Does what the command line says; ends the process where that fails."""
    sys.argv[0] = program  # as recorded tables name it
    try:
        _run(sys.argv[1:], commands, program, about)
    except KeyboardInterrupt:
        _end(program, "stopped; what is written is whole, and what takes long goes on from there", 130)
    except (ValueError, OSError) as error:
        _end(program, str(error), 2)
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError | torch.OutOfMemoryError) and "allocate memory" not in str(error):
            raise
        _end(program, "there is not enough memory for that; use a smaller size, or --device cpu", 2)


def _run(
    arguments: list[str], commands: Mapping[str, type] = COMMANDS, program: str = "distrace", about: str = ABOUT
) -> None:
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            command = tyro.extras.subcommand_cli_from_dict(
                dict(commands), args=arguments, prog=program, description=about
            )
    except SystemExit as stop:
        if stop.code:
            raise ValueError(_one_line(said.getvalue())) from None
        raise
    seed = getattr(command, "seed", None)
    if seed is not None and not 0 <= seed < 2**31:
        raise ValueError(f"--seed {seed} was given; a number from 0 to {2**31 - 1} is needed")
    command.run()


def _one_line(box: str) -> str:
    """The parser's message without the box that it draws around it."""
    words = re.sub(r"\x1b\[[0-9;]*m|[\u2500-\u257f]|-{4,}", " ", box).split()
    return " ".join(words).removeprefix("Parsing error ").removeprefix("Unrecognized options ")


def _end(program: str, sentence: str, status: int) -> None:
    errors.print(f"{program}: {' '.join(sentence.split())}", markup=False, highlight=False)
    sys.exit(status)
