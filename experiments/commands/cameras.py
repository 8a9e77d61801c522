"""The table of cameras found by structure from motion, compared with those that folders of photographs give."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from distrace.camera import Camera
from distrace.cli.cameras import Cameras
from distrace.cli.common import show_table
from distrace.cli.console import start
from distrace.data.photographs import Photographs, load_photographs
from experiments.tables.cameras import camera_errors
from experiments.tables.trials import read_json

PHOTOGRAPHS = {"dtu_scan24_quarter": "image", "templeSparseRing": "."}  # where each set has them


@dataclass(frozen=True)
class CamerasTable:
    """Compare the cameras that `distrace cameras` finds with given ones, up to a similarity."""

    data: tyro.conf.Positional[Path]  # a folder with dtu_scan24_quarter and templeSparseRing
    out: Path = Path("out/cameras-table")  # with a folder of each set
    seed: int = 0

    def run(self) -> None:
        run = start(self.out)
        rows = [self._row(name) for name in PHOTOGRAPHS]
        show_table(rows)
        run.finish({"rows": rows})

    def _row(self, name: str) -> dict:
        """Finds the cameras of a set without those that it gives, and returns their errors."""
        given = load_photographs(self.data / name)
        out = self.out / name
        Cameras(self.data / name / PHOTOGRAPHS[name], out, seed=self.seed).run()
        result = read_json(out / "result.json")
        found = load_photographs(out)
        errors = camera_errors(_cameras(found), _cameras(given))
        figures = {key: result[key] for key in ("reprojection_error", "points", "seconds")}
        return {
            "set": name,
            "photographs": result["photographs"],
            "placed": result["placed"],
            **errors.row(),
            **figures,
        }


def _cameras(photographs: Photographs) -> dict[str, Camera]:
    """Returns the cameras in the folder's world, by name."""
    return {view.name: view.source.camera for view in photographs.views if view.source is not None}
