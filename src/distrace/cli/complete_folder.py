"""`complete` of a folder: many inputs, one after the other or at once, and one file of results."""

import hashlib
import io
import json
import os
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import distrace
from distrace.cli.common import show_table
from distrace.cli.console import Run, console, progress
from distrace.data.depth_image import KINDS
from distrace.data.scan_inputs import CLOUDS
from distrace.files import save_json
from distrace.optional import MissingLibrary
from distrace.processes import parallel_map

READABLE = (*CLOUDS, *KINDS, ".npz")
ROW = "row.json"  # in the folder of each input
SHOWN = ("verdict", "loss", "chamfer", "seconds", "reason")  # of each result


@runtime_checkable
class Command(Protocol):
    """A command that completes one input."""

    @property
    def out(self) -> Path: ...

    def run(self) -> None: ...


@dataclass(frozen=True)
class FolderJob:
    """One input, and the command that completes it."""

    path: Path
    command: Command
    read: tuple[Path, ...] = ()  # other files that the result depends on

    @property
    def mark(self) -> str:
        """Returns a hash of the version, of all options, and of the files that are read."""
        digest = hashlib.sha256(f"{distrace.__version__} {self.command}".encode())
        for path in (self.path, *self.read):
            digest.update(path.read_bytes())
        return digest.hexdigest()[:16]

    def run(self) -> dict[str, Any]:
        """Returns the row of an input, from an earlier run with the same options or a new one.

        An input that cannot be completed has the verdict `refused` and a reason; it is tried again by the next run.
        """
        stored = self.command.out / ROW
        mark = self.mark
        if stored.is_file():
            content = json.loads(stored.read_text(encoding="utf-8"))
            if content.get("made_by") == mark:
                return content["row"]
        try:
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                self.command.run()
        except (ValueError, OSError, RuntimeError, MemoryError, MissingLibrary) as error:
            return {"input": self.path.name, "verdict": "refused", "reason": str(error)}
        result = json.loads((self.command.out / "result.json").read_text(encoding="utf-8"))
        row = {"input": self.path.name, **{key: result[key] for key in SHOWN if key in result}}
        save_json(stored, {"made_by": mark, "row": row})
        return row


def inputs_in(folder: Path) -> list[Path]:
    """Returns the inputs of a folder in order of their names. Raises `ValueError` where there are none."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in READABLE and path.is_file())
    if not found:
        raise ValueError(f"{folder} holds no input; files ending in {', '.join(READABLE)} are looked for")
    return found


def complete_each(run: Run, jobs: Sequence[FolderJob], processes: int | None, cluster: str | None) -> bool:
    """Completes all inputs and writes one table; returns whether any of them failed or was refused."""
    rows = []
    with progress("completing", len(jobs)) as bar:
        if processes is None:
            processes = 1 if run.device.type == "cuda" else os.cpu_count() or 1
        for row in parallel_map(FolderJob.run, jobs, processes, cluster):
            rows.append(row)
            bar.advance(f"{row['input']}: {row['verdict']}")
    rows.sort(key=lambda row: row["input"])
    show_table([{key: value for key, value in row.items() if key != "reason"} for row in rows])
    for row in rows:
        if row["verdict"] == "refused":
            console.print(f"{row['input']} is left out: {row['reason']}")
    run.finish({"rows": rows, "inputs": len(rows)})
    if all(row["verdict"] == "refused" for row in rows):
        raise ValueError(f"none of the {len(rows)} inputs could be completed; the lines above say why")
    return any(row["verdict"] in ("failed", "refused") for row in rows)
