"""Objects from real photographs, measured on held-out views."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from distrace.cli.common import show_table
from distrace.cli.console import start
from distrace.cli.reconstruct import Reconstruct
from experiments.tables.trials import read_json

METHODS = ("ours", "hull")


@dataclass(frozen=True)
class Photographs:
    """Measure held-out photographs against reconstructions: ours, and the visual hull. A second run resumes."""

    folders: tyro.conf.Positional[tuple[Path, ...]]  # of photographs, as for `distrace reconstruct`
    methods: tuple[str, ...] = METHODS
    out: Path = Path("out/evaluate")
    steps: int = Reconstruct.steps
    sizes: tuple[int, ...] = Reconstruct.sizes
    held_out: int = Reconstruct.held_out
    device: str = "cpu"

    def run(self) -> None:
        unknown = set(self.methods) - set(METHODS)
        if unknown or not self.folders or self.held_out < 1:
            given = f"methods {', '.join(self.methods)}, {len(self.folders)} folders and --held-out {self.held_out}"
            raise ValueError(
                f"{given} were given; give folders, methods of {', '.join(METHODS)}, and views to hold out"
            )
        run = start(self.out, self.device)
        rows = []
        evaluations = 0
        for folder in self.folders:
            for method in self.methods:
                result = self._result(folder, method)
                rows += result["rows"]
                evaluations += result["evaluations"]
        show_table(rows)
        run.finish({"rows": rows, "evaluations": evaluations})

    def _result(self, folder: Path, method: str) -> dict:
        """Runs `reconstruct` in a folder of its own, and returns its `result.json`."""
        out = self.out / f"{folder.resolve().name}-{method}"
        options = {name: getattr(self, name) for name in ("steps", "sizes", "held_out", "device")}
        Reconstruct(folder, out, silhouettes_only=method == "hull", **options).run()
        return read_json(out / "result.json")
