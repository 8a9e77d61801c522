"""`bench views`: random views of models and of analytic fields, against the cautious reference."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from distrace.benchmarks import analytic
from distrace.benchmarks.agreement import Measured, badness, measure_view, summaries
from distrace.benchmarks.agreement_page import agreement_page, worst_picture
from distrace.benchmarks.random_views import View, model_views
from distrace.checkpoints.model import Model, bundled_models, load_model
from distrace.cli.common import opened, show_table
from distrace.cli.console import Run, console, origin, progress
from distrace.files import save_text
from distrace.render import STRATEGIES
from distrace.shading import save_png

SHOWN = 10  # of the worst views
SHARE = 5  # a family of analytic fields has one view where a model has so many
DISTORTED = "sofas"  # the model whose first field the families are given


@dataclass(frozen=True)
class Plan:
    """What is measured: views of models, or of the analytic fields, or of both."""

    models: Sequence[str]
    fields: bool
    views: int  # of each model
    sizes: tuple[int, int]
    seed: int
    strategy: str | None  # None: as `render` does by default
    kept: Path | None = None  # a folder of references

    def __post_init__(self) -> None:
        if self.views < 1:
            raise ValueError(f"--views {self.views} was given; at least 1 view of each model is needed")
        if self.strategy is not None and self.strategy not in STRATEGIES:
            raise ValueError(f"--strategy {self.strategy} was given; choose one of {', '.join(STRATEGIES)}")
        low, high = self.sizes
        if not 1 <= low <= high:
            raise ValueError(f"--sizes {low} {high} was given; give the smallest size first, at least 1 pixel")

    @property
    def of_field(self) -> int:
        """The number of views of each family of analytic fields."""
        return -(-self.views // SHARE)

    @property
    def names(self) -> Sequence[str]:
        """The models: those that are named, or all bundled ones where nothing is."""
        return self.models or ([] if self.fields else bundled_models())

    def drawn(self, models: Sequence[Model]) -> Iterator[View]:
        """All views, drawn one by one."""
        for model in models:
            yield from model_views(model, self.views, self.sizes, self.seed)
        if self.fields:
            decoder = load_model(DISTORTED).field(0)
            yield from analytic.analytic_views(decoder, self.of_field, self.sizes, self.seed)

    def count(self) -> int:
        """The number of all views."""
        return len(self.names) * self.views + self.fields * len(analytic.NAMES) * self.of_field


def bench_views(run: Run, plan: Plan) -> None:
    """Measures all views; writes `result.json`, `index.html` and `worst.png`."""
    strategy = plan.strategy or "default"
    config = STRATEGIES[plan.strategy] if plan.strategy else None
    models = [opened(name, run.device) for name in plan.names]  # all at first: a wrong name ends it at once
    rows, worst = [], list[Measured]()
    with progress("views", plan.count()) as bar:
        for view in plan.drawn(models):
            measured = measure_view(view, strategy, config, plan.kept)
            rows.append(measured.row)
            worst = sorted([*worst, measured], key=badness, reverse=True)[:SHOWN]  # images of others are let go
            took = measured.row.seconds + measured.row.reference_seconds
            bar.advance(f"{view.model}: IoU {measured.row.iou:.4f}, {took:.1f} s")
    found = summaries(rows)
    save_png(run.out / "worst.png", worst_picture(worst))
    save_text(run.out / "index.html", agreement_page(strategy, plan.seed, found, rows, worst))
    show_table([asdict(line) for line in found])
    console.print(f"{sum(not row.fails for row in rows)} of {len(rows)} views pass")
    evaluations = {name: sum(getattr(row, name) for row in rows) for name in ("evaluations", "setup_evaluations")}
    facts = {"strategy": strategy, "seed": plan.seed, "views": plan.views, "sizes": list(plan.sizes)}
    content = {"rows": [asdict(row) for row in rows], "summary": [asdict(line) for line in found]}
    run.finish({**content, **facts, **origin(), **evaluations})
