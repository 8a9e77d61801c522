"""Costs and errors of tracing, and the speed of solvers."""

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro

from distrace.benchmarks.measuring import poster_view
from distrace.camera import Camera
from distrace.checkpoints.codes import named_code
from distrace.cli.bench import finish, rows_of, show
from distrace.cli.common import CodeName, ModelName, opened, show_table
from distrace.cli.console import progress, start
from distrace.files import save_json, save_text
from experiments.costs import backward, boundary_gradients, fields, gradients, growth, pages, solvers
from experiments.datasets.splits import on_side

Name = tyro.conf.Positional[ModelName]


@dataclass(frozen=True)
class Fields:
    """Count the wrong pixels of each strategy on fields that break what sphere tracing assumes."""

    model: Name = "sofas"
    out: Path = Path("out/fields")
    code: CodeName = "0"
    size: int = 512  # pixels along each side
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        model = opened(self.model, run.device)
        decoder = model.field(named_code(model, self.code))
        rows = []
        with progress("fields", fields.COUNT) as bar:
            for row in fields.field_rows(decoder, poster_view(self.size).to(run.device)):
                rows.append(row)
                bar.advance(f"{row.field}, {row.strategy}")
        save_text(run.out / "index.html", pages.fields_page(rows))
        finish(run, rows_of(self.model, rows))


@dataclass(frozen=True)
class Growth:
    """Measure cost against the size of image and network, and the number of views and shapes."""

    model: Name = "sofas"
    out: Path = Path("out/growth")
    code: CodeName = "0"
    repeats: int = 5  # timed runs of each row, after one to warm up; a row of over a minute runs once
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        model = opened(self.model, run.device)
        field = model.field(named_code(model, self.code))
        axes = (
            growth.by_size(field, self.repeats, run.device),
            growth.by_network(self.repeats, run.device),
            growth.by_views(field, self.repeats, run.device),
            growth.by_shapes(model, self.repeats),
        )
        rows = []
        with progress("growth", growth.COUNT) as bar, torch.no_grad():
            for axis in axes:
                for row in axis:
                    rows.append(row)
                    save_json(run.out / "rows.json", rows_of(self.model, rows))
                    bar.advance(f"{row.axis} {row.value}, {row.strategy}: {row.seconds:.2f} s")
        save_text(run.out / "index.html", pages.growth_page(rows))
        finish(run, rows_of(self.model, rows))


@dataclass(frozen=True)
class Memory:
    """Measure the memory of one image beyond the weights, of 1024 × 1024 and 2048 × 2048 pixels."""

    model: Name = "sofas"
    out: Path = Path("out/memory")
    code: CodeName = "0"

    def run(self) -> None:
        run = start(self.out)
        named_code(opened(self.model, run.device), self.code)  # so that a wrong name ends here
        rows = []
        with progress("memory", len(growth.MEASURED)) as bar:
            for size in growth.MEASURED:
                mib = growth.peak_memory(self.model, self.code, size)
                rows.append({"model": self.model, "pixels": size, "mib": mib})
                save_json(run.out / "rows.json", rows)
                bar.advance(f"{size} × {size}: {mib:.0f} MiB")
        show_table(rows)
        run.finish({"rows": rows})


@dataclass(frozen=True)
class Gradients:
    """Compare exact derivatives and DIST's with finite differences, on a sphere, a box and a decoder."""

    model: Name = "sofas"
    out: Path = Path("out/gradients")
    code: CodeName = "0"
    size: int = 64  # pixels along each side
    repeats: int = 5  # timed backward passes of a 512 × 512 image, after one to warm up
    device: str = "cpu"  # of these passes

    def run(self) -> None:
        run = start(self.out, self.device)
        model = opened(self.model, run.device)
        code = named_code(model, self.code)
        subjects = gradients.subjects(model, code, self.size)
        rows = []
        ratios = []
        with progress("gradients", gradients.COUNT) as bar:
            for subject in subjects:
                for row, ratio in gradients.ratio_rows(subject):
                    rows.append(row)
                    ratios.append(ratio.numpy())
                    bar.advance(f"{row.field} by {row.parameter}, {row.method}")
        save_text(run.out / "index.html", pages.gradients_page(rows, ratios))
        times = backward.timings(model, code, poster_view().to(run.device), self.repeats)
        facts = rows_of(self.model, rows)
        timing = rows_of(self.model, times)
        show(facts)
        show(timing)
        evaluations = sum(subject.sdf.evaluations for subject in subjects)
        run.finish({"rows": facts, "timing": timing, "evaluations": evaluations})


@dataclass(frozen=True)
class BoundaryGradients:
    """Compare gradients of outlines with Mitsuba's, each against differences of the renderer's own images.

    Needs the extra `clips`, and LLVM 19 for Mitsuba; DRJIT_LIBLLVM_PATH names its library.
    """

    out: Path = Path("out/boundary-gradients")
    size: int = 64  # pixels along each side

    def run(self) -> None:
        run = start(self.out)
        view = Camera.orbit(30, 20, 4.97, focal_mm=85, height=self.size, width=self.size, dtype=torch.float64)
        rows = []
        with progress("boundary gradients", boundary_gradients.COUNT) as bar:
            for row in boundary_gradients.boundary_rows(view):
                rows.append(asdict(row))
                bar.advance(f"{row.field} by {row.parameter}, {row.method}")
        show_table(rows)
        run.finish({"rows": rows})


@dataclass(frozen=True)
class Solvers:
    """Compare how fast Adam and Levenberg–Marquardt complete the held-out shapes."""

    model: Name = "sofas"
    split: str = "sofas"  # whose held-out shapes are completed
    meshes: Path = Path("out/furniture")  # as `distrace data furniture` makes it
    out: Path = Path("out/solvers")

    def run(self) -> None:
        run = start(self.out)
        model = opened(self.model, run.device)
        shapes = on_side("test", self.split)
        measured = []
        with progress("solvers", 2 * len(shapes) * len(solvers.POINTS)) as bar:
            for row, curve in solvers.solver_rows(model, shapes, self.meshes, solvers.RESOLUTION):
                measured.append((row, curve))
                bar.advance(f"{row.shape}, {row.points or 'all'} depths, {row.solver}: {row.loss:.4f}")
        save_text(run.out / "index.html", pages.solvers_page(measured))
        rows = rows_of(self.model, [row for row, _ in measured])
        show(rows)
        curves = [{"seconds": curve.seconds, "losses": curve.losses} for _, curve in measured]
        evaluations = sum(row["evaluations"] for row in rows)
        run.finish({"rows": rows, "curves": curves, "evaluations": evaluations})
