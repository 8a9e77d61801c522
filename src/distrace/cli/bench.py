"""`bench`: what tracing costs and how far it is off, as JSON, as a page and in the terminal."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from distrace.benchmarks import ablation, derivatives, pages
from distrace.benchmarks.measuring import measure, poster_view
from distrace.checkpoints.model import Model, bundled_models
from distrace.cli.bench_views import Plan, bench_views
from distrace.cli.common import opened, show_table
from distrace.cli.console import Run, origin, progress, start
from distrace.files import save_text
from distrace.shading import save_png, side_by_side

HIDDEN = ("model", "share", "runs")  # from the terminal
SHORT: dict[str, str] = {
    "setup_queries": "set-up",
    "per_pixel": "per px",
    "depth_mean": "mean",
    "depth_p99": "p99",
    "depth_max": "max",
}


@dataclass(frozen=True)
class Bench:
    """Measure what tracing costs and how far it is off, against a reference that takes no chances."""

    what: tyro.conf.Positional[Literal["trace", "views", "gradients"]]
    """trace: every strategy on the poster's view; views: whether random views of models are right; gradients: exact
    and DIST's against finite differences, and the time of a backward pass"""
    models: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[MODEL …]"), tyro.conf.Positional] = ()
    """a bundled model, a DeepSDF experiment folder, or a run of `train`; `views` takes any number, by default all
    bundled ones"""
    out: Path = Path("out/bench")
    code: int = 0  # which training shape
    size: int = 512  # pixels along each side, of `trace` and the times of `gradients`
    repeats: int = 5  # timed runs of each row, after one to warm up; a row of over a minute runs once
    views: int = 60  # of `views`: random views of each model
    sizes: tuple[int, int] = (128, 512)  # of `views`: the smallest and the largest image, in pixels along each side
    strategy: str | None = None  # of `views`: as in `distrace render`; by default what `distrace.render` does unasked
    seed: int = 0  # of `views`
    references: Path | None = None  # of `views`: a folder to keep references in, which take most of the time
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        if self.what == "views":
            names = self.models or bundled_models()
            bench_views(run, Plan(names, self.views, self.sizes, self.seed, self.strategy, self.references))
        else:
            getattr(self, f"_{self.what}")(run, opened(self.model, run.device))

    @property
    def model(self) -> str:
        """The one model that all but `views` measure."""
        if len(self.models) != 1:
            given = f"{len(self.models)} models ({', '.join(self.models)})" if self.models else "no model"
            raise ValueError(f"bench {self.what} was given {given}; name one, as in `distrace bench {self.what} sofas`")
        return self.models[0]

    def _trace(self, run: Run, model: Model) -> None:
        camera, cases = poster_view(self.size).to(run.device), []
        with progress("references", ablation.COUNT) as bar:
            for case in ablation.of_model(model, self.code, camera):
                cases.append(case)
                bar.advance(case.strategy)
        with progress("runs", len(cases) * (self.repeats + 1 if self.repeats > 1 else 1)) as bar:
            measured = measure(cases, self.repeats, bar.advance)
        truths = [case.truth.cpu().numpy() for case in cases]
        maps = {row.strategy: pages.query_map(buffers) for row, buffers in measured if row.strategy in pages.MAPPED}
        save_png(run.out / "evaluations.png", side_by_side(list(maps.values())))
        save_text(run.out / "index.html", pages.trace_page(self.model, measured, truths))
        finish(run, rows_of(self.model, [row for row, _ in measured]))

    def _gradients(self, run: Run, model: Model) -> None:
        measured, subjects = [], derivatives.subjects(model, self.code, min(self.size, derivatives.SIZE))
        with progress("gradients", derivatives.COUNT) as bar:
            for subject in subjects:
                for row, ratio in derivatives.ratio_rows(subject):
                    measured.append((row, ratio.numpy()))
                    bar.advance(f"{row.field} by {row.parameter}, {row.method}")
        rows, ratios = zip(*measured)
        timings = derivatives.timings(model, self.code, poster_view(self.size).to(run.device), self.repeats)
        save_text(run.out / "index.html", pages.gradients_page(rows, ratios, timings))
        facts = rows_of(self.model, rows)
        times = rows_of(self.model, timings)
        show(facts)
        show(times)
        evaluations = sum(subject.tally.evaluations for subject in subjects)
        run.finish({"rows": facts, "timing": times, **origin(), "evaluations": evaluations})


def rows_of(model: str, measured: Iterable[Any]) -> list[dict[str, Any]]:
    """Rows as `result.json` has them: each with the model's name."""
    return [{"model": model, **asdict(row)} for row in measured]


def show(rows: Sequence[dict[str, Any]]) -> None:
    show_table([{SHORT.get(key, key): value for key, value in row.items() if key not in HIDDEN} for row in rows])


def finish(run: Run, rows: list[dict[str, Any]]) -> None:
    show(rows)
    evaluations, setup = (sum(row.get(name, 0) for row in rows) for name in ("queries", "setup_queries"))
    run.finish({"rows": rows, **origin(), "evaluations": evaluations, "setup_evaluations": setup})
