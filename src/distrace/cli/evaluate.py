"""`evaluate`: tables of results, as JSON, as pictures and in the terminal."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import tyro

from distrace import depth_tables, pose_table, shading
from distrace.cli.common import ModelName, opened, show_table
from distrace.cli.console import Run, console, origin, progress, start
from distrace.data.split import read_split
from distrace.evaluate import (
    Result,
    completion_results,
    held_out_results,
    picture_of,
    summary,
    training_results,
)
from distrace.files import save_json, save_text
from distrace.fit import FitConfig
from distrace.methods import METHODS
from distrace.page import figure, page, section, table
from distrace.sparse_depth import AZIMUTHS_ELEVATIONS, CONDITIONS, Done, Place, all_trials, done
from distrace.trials import each_done

SHORT = {
    "rotation_median_degrees": "degrees",
    "translation_median_percent": "shift %",
    "focal_median_percent": "focal %",
}


@dataclass(frozen=True)
class Evaluate:
    """Make a table of results; what was done is kept, and a second run goes on from there."""

    name: tyro.conf.Positional[Literal["training", "held-out", "completion", "pose", "sparse-depth", "noise", "focal"]]
    """training: how well a model knows its shapes; held-out: and others, told all distances; completion: from one view;
    pose: how often a camera is found; sparse-depth, noise, focal: completion of each class from fewer, from disturbed
    depths, and at other focal lengths"""
    model: ModelName = "sofas"
    split: str | None = None  # by default that of the model's name
    meshes: Path = Path("out")  # as `distrace data furniture` and `… planes` make them, in folders of their own
    out: Path = Path("out/evaluate")
    points: int = 100  # observed depths, of `completion`
    seed: int = 0
    resolution: int = 256  # of the meshes that are compared
    classes: tuple[str, ...] = ("sofas", "planes", "tables", "chairs")  # of the last three
    models: tuple[str, ...] = ()  # theirs; by default the bundled ones of the same names
    methods: tuple[str, ...] = METHODS  # or also points, points+normals: ours, not knowing the camera
    shapes: int | None = None  # held-out ones of each class; by default all
    views: int = 4  # of each shape
    cameras: int = 50  # of `pose`, for each observation and each disturbance
    jobs: int = 2  # processes, of all but the first three

    def run(self) -> None:
        run = start(self.out)
        if self.name == "pose":
            self._pose(run)
        elif self.name in depth_tables.AXES:
            self._depth(run)
        else:
            self._shapes(run)

    def _depth(self, run: Run) -> None:
        """Each trial leaves a file in `trials`."""
        if self.jobs < 1 or not 1 <= self.views <= len(AZIMUTHS_ELEVATIONS) or (self.shapes or 1) < 1:
            given = f"--jobs {self.jobs} --views {self.views} --shapes {self.shapes}"
            raise ValueError(f"{given} was given; at least 1 of each are needed, and at most 4 views")
        models = self.models or self.classes
        if len(models) != len(self.classes):
            given = f"{len(models)} models ({', '.join(models)}) were given"
            raise ValueError(f"{given} for {len(self.classes)} classes ({', '.join(self.classes)}); give one each")
        place = Place(self.meshes, run.out, tuple(zip(self.classes, models, strict=True)), self.resolution)
        trials = all_trials(self.classes, self.methods, CONDITIONS[self.name](), self.shapes, self.views)
        results: list[Done] = []
        with progress(self.name, len(trials)) as bar:
            for each in each_done(partial(done, place), trials, self.jobs):
                results.append(each)
                bar.advance(f"{each.trial.shape}, {each.trial.method}: {each.chamfer:.2f}")
        place_of = {trial: number for number, trial in enumerate(trials)}
        results.sort(key=lambda each: place_of[each.trial])
        axis = depth_tables.AXES[self.name]
        rows = depth_tables.rows_of(results, axis)
        header, cells = depth_tables.wide(rows, axis)
        show_table([dict(zip(header, line, strict=True)) for line in cells])
        save_text(run.out / "index.html", depth_tables.depth_page(self.name, results, place))
        instances = [each.row() for each in results]
        ratios = depth_tables.ratios(rows, axis)
        evaluations = sum(each.evaluations for each in results)
        run.finish({"rows": rows, "ratios": ratios, "instances": instances, **origin(), "evaluations": evaluations})

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
            for found in each_done(partial(pose_table.found, self.model), wanted, self.jobs):
                kept.append(found)
                pose_table.write_trials(trials, self.model, kept)
                bar.advance(f"{found.trial.observation}, {found.trial.disturbance}: {found.degrees:.2f}°")
        rows = pose_table.rows_of(self.model, kept)
        show_table([{SHORT.get(key, key): value for key, value in row.items() if key != "model"} for row in rows])
        save_text(run.out / "index.html", pose_table.pose_page(self.model, rows))
        run.finish({"rows": rows, **origin(), "evaluations": sum(found.evaluations for found in kept)})

    def _shapes(self, run: Run) -> None:
        opened_model, shapes = opened(self.model, run.device), read_split(self.split or self.model)
        side = "train" if self.name == "training" else "test"
        count = sum(shape.split == side for shape in shapes)
        if self.name == "training":
            results = training_results(opened_model, shapes, self.meshes, self.resolution)
        elif self.name == "held-out":
            results = held_out_results(opened_model, shapes, self.meshes, self.resolution)
        else:
            count *= len(METHODS)
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
