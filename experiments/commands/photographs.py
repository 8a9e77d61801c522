"""Objects from real photographs, judged by views that were held out."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from distrace.cli.common import show_table
from distrace.cli.console import origin, start
from distrace.cli.reconstruct import Reconstruct
from experiments.tables.trials import read_json

METHODS = ("ours", "hull")


@dataclass(frozen=True)
class Photographs:
    """Objects from photographs, judged by held-out views: ours, and the painted visual hull. A second run goes on."""

    folders: tyro.conf.Positional[tuple[Path, ...]]  # of photographs, as `reconstruct` takes them
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
            raise ValueError(f"{given} were given; give folders, some of {', '.join(METHODS)}, and views to hold out")
        run, rows, evaluations = start(self.out, self.device), [], 0
        for folder in self.folders:
            for method in self.methods:
                result = self._result(folder, method)
                rows += result["rows"]
                evaluations += result["evaluations"]
        show_table(rows)
        run.finish({"rows": rows, "evaluations": evaluations, **origin()})

    def _result(self, folder: Path, method: str) -> dict:
        """What `reconstruct` leaves in a folder of its own."""
        out = self.out / f"{folder.resolve().name}-{method}"
        own = {name: getattr(self, name) for name in ("steps", "sizes", "held_out", "device")}
        Reconstruct(folder, out, silhouettes_only=method == "hull", **own).run()
        return read_json(out / "result.json")
