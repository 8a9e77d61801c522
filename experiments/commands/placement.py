"""The table of completions in a sensor's frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from distrace.cli.common import Cluster, show_table
from distrace.cli.console import progress, start
from distrace.processes import parallel_map
from experiments.commands.depth import checked, paired
from experiments.datasets.splits import CLASSES, Meshes
from experiments.tables.placement import Placed, placed, placement_rows, placement_trials, verdict_rows
from experiments.tables.trials import Place


@dataclass(frozen=True)
class Placement:
    """Complete shapes whose turn, tilt, size and place nobody tells, from noisy depths. A second run resumes."""

    classes: tuple[str, ...] = CLASSES
    models: tuple[str, ...] = ()  # of the classes; by default the bundled ones of the same names
    shapes: int | None = None  # held out, of each class; by default all
    invented: int = 10  # procedural shapes of each class, of seeds that nothing was trained on
    told: bool = True  # also with the true placement told
    meshes: Meshes = Path("out")
    out: Path = Path("out/evaluate")
    resolution: int = 96  # of the meshes that are compared
    jobs: int = 1  # processes; times are those of one at a time
    cluster: Cluster = None  # of Ray, instead of these processes

    def run(self) -> None:
        checked(self.jobs, self.shapes)
        run = start(self.out)
        place = Place(self.meshes, run.out, paired(self.classes, self.models), self.resolution)
        trials = placement_trials(self.classes, self.shapes, self.invented, self.told)
        results: list[Placed] = []
        with progress("placement", len(trials)) as bar:
            for each in self._results(place, trials):
                results.append(each)
                errors = f"{each.degrees:.0f}°, {each.size_percent:.0f} %, {each.centre_percent:.0f} %"
                bar.advance(f"{each.trial.shape}: {errors}, {each.chamfer:.2f}, {each.verdict}")
        order = {trial: number for number, trial in enumerate(trials)}
        results.sort(key=lambda each: order[each.trial])
        rows = placement_rows(results)
        verdicts = verdict_rows(results)
        show_table(rows)
        show_table(verdicts)
        facts = {"rows": rows, "verdicts": verdicts, "instances": [each.row() for each in results]}
        run.finish({**facts, "evaluations": sum(each.evaluations for each in results)})

    def _results(self, place: Place, trials: Sequence):
        """Returns the results; of one job in this process, with all of its threads."""
        work = partial(placed, place)
        if self.jobs == 1 and self.cluster is None:
            return map(work, trials)
        return parallel_map(work, trials, self.jobs, self.cluster)
