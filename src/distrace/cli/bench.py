"""`bench`: the tracer's cost and error, as JSON and in the terminal."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from distrace.benchmarks import ablation
from distrace.benchmarks.measuring import measure, poster_view
from distrace.benchmarks.pictures import MAPPED, query_map
from distrace.checking.gradcheck import check_gradients
from distrace.checkpoints.codes import named_code
from distrace.checkpoints.model import Model, bundled_models
from distrace.cli.bench_views import Plan, bench_views
from distrace.cli.common import CodeName, default, opened, show_table
from distrace.cli.console import Run, progress, start
from distrace.shading import save_png, side_by_side

HIDDEN = ("model", "share", "runs")  # columns that the terminal does not show
CHECKED = 48  # pixels along each side, of the image whose derivatives are checked
SHORT: dict[str, str] = {
    "setup_queries": "set-up",
    "per_pixel": "per px",
    "depth_mean": "mean",
    "depth_p99": "p99",
    "depth_max": "max",
}


@dataclass(frozen=True)
class Bench:
    """Measure the tracer's cost and error against a cautious reference."""

    what: tyro.conf.Positional[Literal["trace", "views", "gradients"]]
    """trace: every strategy on one view; views: the default tracer on random views; gradients: derivatives against
    finite differences"""
    models: tyro.conf.Positional[
        Annotated[
            tuple[str, ...], tyro.conf.arg(metavar="[MODEL …]", help_behavior_hint="(default of `views`: all bundled)")
        ]
    ] = ()
    """a bundled model, a DeepSDF experiment folder, or a run of `train`; `views` takes any number, the others one"""
    out: Path = Path("out/bench")
    code: CodeName = "0"  # for `trace` and `gradients`
    size: int = 512  # pixels along each side, for `trace`; for `gradients` at most 48
    repeats: int = 5  # timed runs of each row, after a warm-up; a row that takes over a minute runs once
    views: int = 60  # for `views`: random views of each model
    sizes: tuple[int, int] = (128, 512)  # for `views`: the smallest and the largest image, in pixels along each side
    strategy: Annotated[str | None, default("fast", "STR")] = None  # for `views`: as in `distrace render`
    seed: int = 0  # for `views`
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        if self.what == "views":
            names = self.models or bundled_models()
            bench_views(run, Plan(names, self.views, self.sizes, self.seed, self.strategy))
        else:
            getattr(self, f"_{self.what}")(run, opened(self.model, run.device))

    @property
    def model(self) -> str:
        """Returns the one model that `trace` and `gradients` measure. Raises `ValueError` for any other number."""
        if len(self.models) != 1:
            given = f"{len(self.models)} models ({', '.join(self.models)})" if self.models else "no model"
            raise ValueError(f"bench {self.what} was given {given}; name one, as in `distrace bench {self.what} sofas`")
        return self.models[0]

    def _trace(self, run: Run, model: Model) -> None:
        camera = poster_view(self.size).to(run.device)
        cases = []
        with progress("references", ablation.COUNT) as bar:
            for case in ablation.of_model(model, named_code(model, self.code), camera):
                cases.append(case)
                bar.advance(case.strategy)
        with progress("runs", len(cases) * (self.repeats + 1 if self.repeats > 1 else 1)) as bar:
            measured = measure(cases, self.repeats, bar.advance)
        maps = [query_map(buffers) for row, buffers in measured if row.strategy in MAPPED]
        save_png(run.out / "evaluations.png", side_by_side(maps))
        finish(run, rows_of(self.model, [row for row, _ in measured]))

    def _gradients(self, run: Run, model: Model) -> None:
        field = model.field(named_code(model, self.code))
        found = check_gradients(field, poster_view(min(self.size, CHECKED)).to(run.device))
        rows = [
            {
                "model": self.model,
                "field": "decoder",
                "quantity": row.quantity,
                "parameter": row.parameter,
                "method": "exact",
                "relative_error": row.median,
                "worst": row.worst,
                "pixels": row.pixels,
                "left_out": row.left_out,
                "verdict": row.verdict,
            }
            for row in found.rows
        ]
        show(rows)
        run.finish({"rows": rows, "evaluations": found.evaluations})


def rows_of(model: str, measured: Iterable[Any]) -> list[dict[str, Any]]:
    """Returns rows as `result.json` has them: each with the model's name."""
    return [{"model": model, **asdict(row)} for row in measured]


def show(rows: Sequence[dict[str, Any]]) -> None:
    show_table([{SHORT.get(key, key): value for key, value in row.items() if key not in HIDDEN} for row in rows])


def finish(run: Run, rows: list[dict[str, Any]]) -> None:
    show(rows)
    evaluations = sum(row.get("queries", 0) for row in rows)
    setup_evaluations = sum(row.get("setup_queries", 0) for row in rows)
    run.finish({"rows": rows, "evaluations": evaluations, "setup_evaluations": setup_evaluations})
