"""`evaluate`: tables of results, as JSON, as pictures and in the terminal."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from distrace import pose_table, shading
from distrace.cli.common import ModelName, opened, show_table
from distrace.cli.console import Run, console, origin, progress, start
from distrace.data.split import read_split
from distrace.evaluate import (
    METHODS,
    Result,
    completion_results,
    picture_of,
    summary,
    training_results,
)
from distrace.files import save_json, save_text
from distrace.fit import FitConfig
from distrace.page import figure, page, section, table

SHORT = {
    "rotation_median_degrees": "degrees",
    "translation_median_percent": "shift %",
    "focal_median_percent": "focal %",
}


@dataclass(frozen=True)
class Evaluate:
    """Make a table of results: how well a model knows its training shapes or completes the held-out ones, or how often
    a camera is found from one view."""

    name: tyro.conf.Positional[Literal["training", "completion", "pose"]]
    model: ModelName = "sofas"
    split: str = "sofas"
    meshes: Path = Path("out/furniture")  # as `distrace data furniture` makes it
    out: Path = Path("out/evaluate")
    points: int = 100  # observed depths, for completion
    seed: int = 0
    resolution: int = 256  # of the meshes that are compared
    cameras: int = 50  # of `pose`, for each observation and each disturbance
    jobs: int = 2  # processes, of `pose`

    def run(self) -> None:
        run = start(self.out)
        if self.name == "pose":
            self._pose(run)
        else:
            self._shapes(run)

    def _pose(self, run: Run) -> None:
        """What an earlier run has done is taken from its `trials.json`."""
        if self.cameras < 1 or self.jobs < 1:
            raise ValueError(f"--cameras {self.cameras} and --jobs {self.jobs} were given; both must be at least 1")
        opened(self.model, run.device)
        trials = run.out / "trials.json"
        kept = pose_table.read_trials(trials, self.model)
        known = {found.trial for found in kept}
        wanted = [trial for trial in pose_table.all_trials(self.cameras) if trial not in known]
        with progress("cameras", len(wanted)) as bar:
            for found in pose_table.found_each(self.model, wanted, self.jobs):
                kept.append(found)
                pose_table.write_trials(trials, self.model, kept)
                bar.advance(f"{found.trial.observation}, {found.trial.disturbance}: {found.degrees:.2f}°")
        rows = pose_table.rows_of(self.model, kept)
        show_table([{SHORT.get(key, key): value for key, value in row.items() if key != "model"} for row in rows])
        save_text(run.out / "index.html", pose_table.pose_page(self.model, rows))
        run.finish({"rows": rows, **origin(), "evaluations": sum(found.evaluations for found in kept)})

    def _shapes(self, run: Run) -> None:
        opened_model, shapes = opened(self.model, run.device), read_split(self.split)
        if self.name == "training":
            count = sum(shape.split == "train" for shape in shapes)
            results = training_results(opened_model, shapes, self.meshes, self.resolution)
        else:
            count = sum(shape.split == "test" for shape in shapes) * len(METHODS)
            results = completion_results(
                opened_model, shapes, self.meshes, self.points, FitConfig(seed=self.seed), self.resolution
            )
        kept: list[Result] = []
        with progress(self.name, count) as bar:
            for result in results:
                kept.append(result)
                save_json(run.out / "rows.json", [done.row(self.model) for done in kept])
                bar.advance(f"{result.shape}, {result.method}: {result.chamfer:.3f}")
        _record(run, self.name, self.model, kept)


def _record(run: Run, name: str, model: str, results: list[Result]) -> None:
    if not results:
        raise ValueError(f"{model} and the split have no shape in common that {name} is about; give a --split that has")
    rows = [result.row(model) for result in results]
    totals = summary(results)
    show_table(rows)
    for method, values in totals.items():
        console.print(f"{method}: " + ", ".join(f"{word} {value:.3f}" for word, value in values.items()))
    sheet = picture_of(results)
    shading.save_png(run.out / "shapes.png", sheet)
    lead = "Chamfer distance × 1000: mean squared distances, 30,000 points a side, in the frame of the unit sphere."
    cells = [[str(value) for value in row.values()] for row in rows]
    parts = [
        section("Table", table(list(rows[0]), cells)),
        section("Shapes", figure(sheet, "true surface, then each method")),
    ]
    save_text(run.out / "index.html", page(f"{name}: {model}", lead, parts))
    run.finish({"rows": rows, "summary": totals, **origin()})
