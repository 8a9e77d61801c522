"""The tables of completion from one view, and of clips."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median

import tyro

from distrace.cli.common import Cluster, show_table
from distrace.cli.console import console, progress, start
from distrace.files import save_text
from distrace.processes import parallel_map
from experiments.datasets.splits import CLASSES, Meshes
from experiments.tables import depth_tables
from experiments.tables.clip_page import save_clip_page
from experiments.tables.focal import Rendering, rendering_rows, renderings_of
from experiments.tables.methods import METHODS
from experiments.tables.multiview import METHODS as METHODS_OF_CLIPS
from experiments.tables.multiview import ClipTrial, clip_done, described, multiview_rows, settings_of
from experiments.tables.sparse_depth import (
    AZIMUTHS_ELEVATIONS,
    CONDITIONS,
    Done,
    Trial,
    all_trials,
    done,
    held_out,
)
from experiments.tables.spread import spread_rows
from experiments.tables.trials import Place


@dataclass(frozen=True)
class _DepthTable:
    classes: tuple[str, ...] = CLASSES  # bundled splits, or CSV files
    models: tuple[str, ...] = ()  # of the classes; by default the bundled ones of the same names
    methods: tuple[str, ...] = METHODS  # also points, points+normals: ours without the camera
    shapes: int | None = None  # held out, of each class; by default all
    views: int = len(AZIMUTHS_ELEVATIONS)  # of each shape
    meshes: Meshes = Path("out")
    out: Path = Path("out/evaluate")
    resolution: int = 192  # of the meshes that are compared
    jobs: int = 2  # processes
    cluster: Cluster = None  # of Ray, instead of these processes
    device: str = "cpu"

    def _run(self, name: str, extra: Callable[[Place, list[Trial]], dict] = lambda place, trials: {}) -> None:
        """Runs the trials that have no file in `trials`, and writes the table. `extra` returns further facts."""
        checked(self.jobs, self.shapes, self.views)
        run = start(self.out, self.device)
        models = paired(self.classes, self.models)
        place = Place(self.meshes, run.out, models, self.resolution, run.device)
        trials = all_trials(self.classes, self.methods, CONDITIONS[name](), self.shapes, self.views)
        results: list[Done] = []
        with progress(name, len(trials)) as bar:
            for each in parallel_map(partial(done, place), trials, self.jobs, self.cluster):
                results.append(each)
                bar.advance(f"{each.trial.shape}, {each.trial.method}: {each.chamfer:.2f}")
        order = {trial: number for number, trial in enumerate(trials)}
        results.sort(key=lambda each: order[each.trial])
        rows = depth_tables.rows_of(results, depth_tables.AXES[name])
        header, cells = depth_tables.wide(rows, depth_tables.AXES[name])
        show_table([dict(zip(header, line, strict=True)) for line in cells])
        save_text(run.out / "index.html", depth_tables.depth_page(name, results, place))
        facts = {
            "rows": rows,
            "ratios": depth_tables.ratios(rows, depth_tables.AXES[name]),
            "instances": [each.row() for each in results],
            "evaluations": sum(each.evaluations for each in results),
        }
        run.finish({**facts, **extra(place, trials)})


@dataclass(frozen=True)
class SparseDepth(_DepthTable):
    """Make the published table: held-out shapes from ever fewer depths of one view. A second run resumes."""

    def run(self) -> None:
        self._run("sparse-depth")


@dataclass(frozen=True)
class Noise(_DepthTable):
    """Complete shapes from a tenth of the depths with noise, steps, outliers or holes. A second run resumes."""

    def run(self) -> None:
        self._run("noise")


@dataclass(frozen=True)
class Focal(_DepthTable):
    """Complete shapes from a tenth of the depths at other focal lengths, and render each fit at all of them.

    A second run resumes.
    """

    def run(self) -> None:
        self._run("focal", self._tested)

    def _tested(self, place: Place, trials: list[Trial]) -> dict:
        usual = [trial for trial in trials if trial.focal_ratio == 1.0]
        renderings: list[Rendering] = []
        with progress("rendering at other focal lengths", len(usual)) as bar:
            for of_trial in parallel_map(partial(renderings_of, place), usual, self.jobs, self.cluster):
                renderings += of_trial
                bar.advance()
        rows = sorted(
            rendering_rows(renderings), key=lambda row: (self.classes.index(str(row["class"])), str(row["method"]))
        )
        show_table(rows)
        return {"tests": rows}


@dataclass(frozen=True)
class Spread:
    """Correlate the spread of several completions with the error of one."""

    classes: tuple[str, ...] = CLASSES
    models: tuple[str, ...] = ()  # of the classes; by default the bundled ones of the same names
    shapes: int | None = None  # held out, of each class; by default all
    meshes: Meshes = Path("out")
    out: Path = Path("out/evaluate")
    jobs: int = 2  # processes
    cluster: Cluster = None  # of Ray, instead of these processes

    def run(self) -> None:
        checked(self.jobs, self.shapes)
        run = start(self.out)
        rows = []
        models = paired(self.classes, self.models)
        chosen = {category: held_out(category, self.shapes) for category in self.classes}
        with progress("spread", sum(map(len, chosen.values()))) as bar:
            for category, model in models:
                for row in spread_rows(category, chosen[category], model, self.meshes, self.jobs, self.cluster):
                    rows.append(asdict(row))
                    bar.advance(f"{row.shape}: {row.correlation:.2f}")
        show_table(rows)
        medians = {c: median(row["correlation"] for row in rows if row["category"] == c) for c in self.classes}
        console.print("median rank correlation: " + ", ".join(f"{name} {value:.2f}" for name, value in medians.items()))
        run.finish({"rows": rows, "median_correlation": medians})


@dataclass(frozen=True)
class Multiview:
    """Fit held-out shapes to clips: ours, masks alone, the nearest training shape, stereo. A second run resumes.

    Each clip has a page with its frames, the surface of each method, and its distance from the true one.
    """

    clips: tyro.conf.Positional[tuple[Path, ...]]  # folders made by `python -m experiments clip`
    methods: tuple[str, ...] = METHODS_OF_CLIPS
    model: str | None = None  # by default the bundled one of the clip's split
    meshes: Meshes = Path("out")
    out: Path = Path("out/evaluate")
    jobs: int = 2  # processes
    cluster: Cluster = None  # of Ray, instead of these processes

    def run(self) -> None:
        checked(self.jobs, None)
        if not self.clips:
            raise ValueError("no clips were given; `python -m experiments clip SHAPE` makes one")
        for method in self.methods:
            settings_of(method)
        for folder in self.clips:
            described(folder)
        run = start(self.out)
        results = []
        trials_of = {
            clip: [ClipTrial(clip, method, self.meshes, run.out, self.model) for method in self.methods]
            for clip in self.clips
        }
        trials = [trial for of_clip in trials_of.values() for trial in of_clip]
        with progress("multiview", len(trials)) as bar:
            for each in parallel_map(clip_done, trials, self.jobs, self.cluster):
                results.append(each)
                bar.advance(f"{each.shape}, {each.method}: {each.chamfer:.2f}")
        results.sort(key=lambda each: (each.category, each.background, each.shape, self.methods.index(each.method)))
        for clip, of_clip in trials_of.items():
            save_clip_page(run.out / "pages", clip, of_clip, self.meshes)
        rows = multiview_rows(results)
        show_table(rows)
        run.finish({"rows": rows, "instances": [each.row() for each in results]})


def checked(jobs: int, shapes: int | None, views: int = 1) -> None:
    """Raises `ValueError` for numbers that make no table."""
    if jobs < 1 or not 1 <= views <= len(AZIMUTHS_ELEVATIONS) or (shapes is not None and shapes < 1):
        given = f"--jobs {jobs} --views {views}" + ("" if shapes is None else f" --shapes {shapes}")
        raise ValueError(f"{given} were given; at least 1 of each are needed, and at most 4 views")


def paired(classes: Sequence[str], models: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Returns each class with its model. Raises `ValueError` for more or fewer models than classes."""
    models = models or classes
    if not classes:
        raise ValueError(f"--classes names none; choose from {', '.join(CLASSES)}, or give CSV files")
    if len(models) != len(classes):
        given = f"{len(models)} models ({', '.join(models)}) were given"
        raise ValueError(f"{given} for {len(classes)} classes ({', '.join(classes)}); give one each")
    return tuple(zip(classes, models, strict=True))
