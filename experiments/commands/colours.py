"""The table of colours and new lights."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from distrace.cli.common import Cluster, show_table
from distrace.cli.console import progress, start
from distrace.processes import parallel_map
from experiments.clips.mitsuba_scene import mitsuba
from experiments.commands.depth import checked, paired
from experiments.datasets.splits import Meshes
from experiments.tables.colours import Agreement, ColourTrial, colour_rows, colour_trials, coloured
from experiments.tables.trials import Place


@dataclass(frozen=True)
class Colours:
    """Find the colours of held-out shapes from photographs by Mitsuba, and re-light them. A second run resumes."""

    classes: tuple[str, ...] = ("sofas", "chairs", "tables")
    models: tuple[str, ...] = ()  # of the classes; by default the bundled ones of the same names
    shapes: int | None = None  # held out, of each class, at random; by default all
    photographs: tuple[int, ...] = (1, 8)  # of each shape
    meshes: Meshes = Path("out")
    out: Path = Path("out/colours")
    jobs: int = 1  # processes
    cluster: Cluster = None  # of Ray, instead of these processes

    def run(self) -> None:
        checked(self.jobs, self.shapes)
        if not self.photographs or not all(1 <= count <= 8 for count in self.photographs):
            raise ValueError(f"--photographs {self.photographs} was given; give numbers from 1 to 8")
        run = start(self.out)
        version = mitsuba().__version__
        place = Place(self.meshes, run.out, paired(self.classes, self.models))
        trials = colour_trials(self.classes, self.shapes, self.photographs)
        results: list[tuple[ColourTrial, list[Agreement]]] = []
        with progress("colours", len(trials)) as bar:
            for trial, agreements in parallel_map(partial(coloured, place), trials, self.jobs, self.cluster):
                results.append((trial, agreements))
                bar.advance(f"{trial.shape}, {trial.photographs}: {agreements[0].psnr_views:.1f} dB")
        order = {trial: number for number, trial in enumerate(trials)}
        results.sort(key=lambda result: order[result[0]])
        rows = colour_rows(results)
        show_table(rows)
        run.finish({"rows": rows, "mitsuba": version, "evaluations": 0})
