"""Tables of models and of fits, as JSON, as pictures and in the terminal."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from distrace import shading
from distrace.cli.common import Cluster, ModelName, opened, show_table
from distrace.cli.console import Run, console, progress, start
from distrace.files import save_json, save_text
from distrace.fitting.fit_code import CodeFitConfig
from distrace.processes import parallel_map
from distrace.report.page import figure, page, section, table
from experiments.datasets.splits import Meshes, on_side
from experiments.tables import pose as pose_table
from experiments.tables.completion import (
    METHODS,
    Result,
    completion_results,
    held_out_results,
    picture_of,
    summary,
    training_results,
)

SHORT = {
    "rotation_median_degrees": "degrees",
    "translation_median_percent": "shift %",
    "focal_median_percent": "focal %",
}


@dataclass(frozen=True)
class _OfSplit:
    model: ModelName = "sofas"
    split: str | None = None  # by default that of the model's name
    meshes: Meshes = Path("out")
    out: Path = Path("out/evaluate")
    resolution: int = 256  # of the meshes that are compared

    def _run(self, name: str, side: str, results_of: Callable[..., Iterable[Result]], methods: int = 1) -> None:
        run = start(self.out)
        shapes = on_side(side, self.split or self.model)
        results = results_of(opened(self.model, run.device), shapes, self.meshes, resolution=self.resolution)
        _collect(run, name, self.model, results, methods * len(shapes))


@dataclass(frozen=True)
class Training(_OfSplit):
    """Measure the training shapes as a model represents them."""

    def run(self) -> None:
        self._run("training", "train", training_results)


@dataclass(frozen=True)
class HeldOut(_OfSplit):
    """Measure the held-out shapes, fitted to distances all around them: the best that a model can represent."""

    def run(self) -> None:
        self._run("held-out", "test", held_out_results)


@dataclass(frozen=True)
class Completion(_OfSplit):
    """Complete held-out shapes from sparse depths of one view, by DeepSDF and by ours."""

    points: int = 100  # observed depths
    seed: int = 0

    def run(self) -> None:
        results = partial(completion_results, points=self.points, config=CodeFitConfig(seed=self.seed))
        self._run("completion", "test", results, len(METHODS))


@dataclass(frozen=True)
class Pose:
    """Count how often a disturbed camera is found from one view; a second run resumes from `trials.json`."""

    model: ModelName = "sofas"
    out: Path = Path("out/evaluate")
    cameras: int = 50  # for each observation and each disturbance
    jobs: int = 2  # processes
    cluster: Cluster = None  # of Ray, instead of these processes

    def run(self) -> None:
        run = start(self.out)
        if self.cameras < 1 or self.jobs < 1:
            raise ValueError(f"--cameras {self.cameras} and --jobs {self.jobs} were given; both must be at least 1")
        opened(self.model, run.device)
        trials = run.out / "trials.json"
        finished = pose_table.read_trials(trials, self.model)
        done = {found.trial for found in finished}
        missing = [trial for trial in pose_table.all_trials(self.cameras) if trial not in done]
        with progress("cameras", len(missing)) as bar:
            for found in parallel_map(partial(pose_table.found, self.model), missing, self.jobs, self.cluster):
                finished.append(found)
                pose_table.write_trials(trials, self.model, finished)
                bar.advance(f"{found.trial.observation}, {found.trial.disturbance}: {found.degrees:.2f}°")
        rows = pose_table.rows_of(self.model, finished)
        show_table([{SHORT.get(key, key): value for key, value in row.items() if key != "model"} for row in rows])
        save_text(run.out / "index.html", pose_table.pose_page(self.model, rows))
        run.finish({"rows": rows, "evaluations": sum(found.evaluations for found in finished)})


def _collect(run: Run, name: str, model: str, results: Iterable[Result], count: int) -> None:
    """Writes the rows as they are measured, then the page, the picture and `result.json`."""
    finished: list[Result] = []
    with progress(name, count) as bar:
        for result in results:
            finished.append(result)
            save_json(run.out / "rows.json", [each.row(model) for each in finished])
            bar.advance(f"{result.shape}, {result.method}: {result.chamfer:.3f}")
    _save(run, name, model, finished)


def _save(run: Run, name: str, model: str, results: list[Result]) -> None:
    if not results:
        raise ValueError(f"{model} and the split have no shape in common for {name}; give a --split that has one")
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
    run.finish({"rows": rows, "summary": totals})
