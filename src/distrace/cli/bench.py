"""`bench`: what tracing costs and how far it is off, as JSON, as a page and in the terminal."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from distrace.checkpoint import Model
from distrace.cli.bench_views import Plan, bench_views
from distrace.cli.common import Flag, opened, show_table
from distrace.cli.console import Run, origin, progress, start
from distrace.data.split import on_side
from distrace.evaluation import ablation, backward, fields, gradients, growth, solvers, tables
from distrace.evaluation.bench import measure, poster_view
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

    what: tyro.conf.Positional[Literal["trace", "fields", "growth", "memory", "gradients", "solvers", "views"]]
    """trace: every strategy on the poster's view; fields: on fields that break what sphere tracing assumes; growth:
    with the size of the image, of the network and the numbers of views and shapes; memory: beyond the weights, up to
    4096 pixels; gradients: exact and DIST's against finite differences, and the time of a backward pass; solvers: how
    fast Adam and Levenberg–Marquardt complete the held-out shapes; views: whether random views of models are right"""
    models: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[MODEL …]"), tyro.conf.Positional] = ()
    """a bundled model, a DeepSDF experiment folder, or a run of `train`; `views` takes any number, by default all
    bundled ones"""
    out: Path = Path("out/bench")
    code: int = 0  # which training shape
    size: int = 512  # pixels along each side, of `trace`, `fields` and the times of `gradients`
    repeats: int = 5  # timed runs of each row, after one to warm up; a row of over a minute runs once
    meshes: Path = Path("out/furniture")  # for `solvers`, as `distrace data furniture` makes it
    split: str = "sofas"  # whose held-out shapes `solvers` completes
    views: int = 60  # of `views`: random views of each model, and a fifth as many of each family of fields
    sizes: tuple[int, int] = (128, 512)  # of `views`: the smallest and the largest image, in pixels along each side
    fields: Flag = False  # of `views`: analytic fields, too; without MODEL, these alone
    strategy: str | None = None  # of `views`: as in `distrace render`; by default what `distrace.render` does unasked
    seed: int = 0  # of `views`
    references: Path | None = None  # of `views`: a folder to keep references in, which take most of the time
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        if self.what == "views":
            drawn = self.models, self.fields, self.views, self.sizes, self.seed, self.strategy
            bench_views(run, Plan(*drawn, kept=self.references))
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
        maps = {row.strategy: tables.query_map(buffers) for row, buffers in measured if row.strategy in tables.MAPPED}
        save_png(run.out / "evaluations.png", side_by_side(list(maps.values())))
        save_text(run.out / "index.html", tables.trace_page(self.model, measured, truths))
        _finish(run, self._rows(row for row, _ in measured))

    def _fields(self, run: Run, model: Model) -> None:
        rows = []
        with progress("fields", fields.COUNT) as bar:
            for row in fields.field_rows(model.field(self.code), poster_view(self.size).to(run.device)):
                rows.append(row)
                bar.advance(f"{row.field}, {row.strategy}")
        save_text(run.out / "index.html", tables.fields_page(rows))
        _finish(run, self._rows(rows))

    def _growth(self, run: Run, model: Model) -> None:
        field, rows = model.field(self.code), []
        axes = (
            growth.by_size(field, self.repeats, run.device),
            growth.by_network(self.repeats, run.device),
            growth.by_views(field, self.repeats, run.device),
            growth.by_shapes(model, self.repeats),
        )
        with progress("growth", growth.COUNT) as bar, torch.no_grad():
            for axis in axes:
                for row in axis:
                    rows.append(row)
                    bar.advance(f"{row.axis} {row.value}, {row.strategy}: {row.seconds:.2f} s")
        save_text(run.out / "index.html", tables.growth_page(rows))
        _finish(run, self._rows(rows))

    def _memory(self, run: Run, _: Model) -> None:
        rows = []
        with progress("memory", len(growth.MEASURED)) as bar:
            for size in growth.MEASURED:
                rows.append(
                    {"model": self.model, "pixels": size, "mib": growth.peak_memory(self.model, self.code, size)}
                )
                bar.advance(f"{size} × {size}: {rows[-1]['mib']:.0f} MiB")
        show_table(rows)
        run.finish({"rows": rows, **origin()})

    def _gradients(self, run: Run, model: Model) -> None:
        measured, subjects = [], gradients.subjects(model, self.code, min(self.size, gradients.SIZE))
        with progress("gradients", gradients.COUNT) as bar:
            for subject in subjects:
                for row, ratio in gradients.ratio_rows(subject):
                    measured.append((row, ratio.numpy()))
                    bar.advance(f"{row.field} by {row.parameter}, {row.method}")
        rows, ratios = zip(*measured)
        timings = backward.timings(model, self.code, poster_view(self.size).to(run.device), self.repeats)
        save_text(run.out / "index.html", tables.gradients_page(rows, ratios, timings))
        facts = self._rows(rows)
        times = self._rows(timings)
        _show(facts)
        _show(times)
        evaluations = sum(subject.tally.evaluations for subject in subjects)
        run.finish({"rows": facts, "timing": times, **origin(), "evaluations": evaluations})

    def _solvers(self, run: Run, model: Model) -> None:
        shapes, measured = on_side("test", self.split), []
        with progress("solvers", 2 * len(shapes) * len(solvers.POINTS)) as bar:
            for row, curve in solvers.solver_rows(model, shapes, self.meshes, solvers.RESOLUTION):
                measured.append((row, curve))
                bar.advance(f"{row.shape}, {row.points or 'all'} depths, {row.solver}: {row.loss:.4f}")
        save_text(run.out / "index.html", tables.solvers_page(measured))
        rows = self._rows(row for row, _ in measured)
        _show(rows)
        courses = [{"seconds": curve.seconds, "losses": curve.losses} for _, curve in measured]
        evaluations = sum(row["evaluations"] for row in rows)
        run.finish({"rows": rows, "curves": courses, **origin(), "evaluations": evaluations})

    def _rows(self, measured: Iterable[Any]) -> list[dict[str, Any]]:
        return [{"model": self.model, **asdict(row)} for row in measured]


def _show(rows: Sequence[dict[str, Any]]) -> None:
    show_table([{SHORT.get(key, key): value for key, value in row.items() if key not in HIDDEN} for row in rows])


def _finish(run: Run, rows: list[dict[str, Any]]) -> None:
    _show(rows)
    evaluations, setup = (sum(row.get(name, 0) for row in rows) for name in ("queries", "setup_queries"))
    run.finish({"rows": rows, **origin(), "evaluations": evaluations, "setup_evaluations": setup})
