"""`bench views`: random views of models against the cautious reference."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from distrace.benchmarks.agreement import Measured, Reference, badness, measure_view, reference_of, summaries
from distrace.benchmarks.pictures import pictures_of
from distrace.benchmarks.random_views import RandomView, model_views
from distrace.checkpoints.model import Model
from distrace.cli.common import opened, show_table
from distrace.cli.console import Run, progress
from distrace.render import STRATEGIES
from distrace.shading import grid, save_png

SHOWN = 10  # of the worst views


@dataclass(frozen=True)
class Plan:
    """Random views to measure, and how."""

    models: Sequence[str]
    views: int  # of each model
    sizes: tuple[int, int]
    seed: int
    strategy: str | None  # None: the default of `render`

    def __post_init__(self) -> None:
        if self.views < 1:
            raise ValueError(f"--views {self.views} was given; at least 1 view of each model is needed")
        if self.strategy is not None and self.strategy not in STRATEGIES:
            raise ValueError(f"--strategy {self.strategy} was given; choose one of {', '.join(STRATEGIES)}")
        low, high = self.sizes
        if not 1 <= low <= high:
            raise ValueError(f"--sizes {low} {high} was given; give the smallest size first, at least 1 pixel")

    def draw(self, models: Sequence[Model]) -> Iterator[RandomView]:
        """Draws all views, one by one."""
        for model in models:
            yield from model_views(model, self.views, self.sizes, self.seed)

    def reference(self, view: RandomView) -> Reference:
        """Computes the reference of a view."""
        return reference_of(view)

    def count(self) -> int:
        """Returns the number of all views."""
        return len(self.models) * self.views


def bench_views(run: Run, plan: Plan) -> None:
    """Measures all views; writes `result.json` and `worst.png`."""
    strategy = plan.strategy or "default"
    config = STRATEGIES[plan.strategy] if plan.strategy else None
    models = [opened(name, run.device) for name in plan.models]  # before any view: a wrong name must fail at once
    rows = []
    worst: list[Measured] = []
    with progress("views", plan.count()) as bar:
        for view in plan.draw(models):
            measured = measure_view(view, strategy, config, plan.reference)
            rows.append(measured.row)
            worst = sorted([*worst, measured], key=badness, reverse=True)[:SHOWN]  # frees the other images
            seconds = measured.row.seconds + measured.row.reference_seconds
            bar.advance(f"{view.model}: IoU {measured.row.iou:.4f}, {seconds:.1f} s")
    lines = summaries(rows)
    save_png(run.out / "worst.png", grid([pictures_of(measured) for measured in worst]))
    show_table([asdict(line) for line in lines])
    evaluations = {name: sum(getattr(row, name) for row in rows) for name in ("evaluations", "setup_evaluations")}
    facts = {"strategy": strategy, "seed": plan.seed, "views": plan.views, "sizes": list(plan.sizes)}
    content = {"rows": [asdict(row) for row in rows], "summary": [asdict(line) for line in lines]}
    passed = sum(not row.fails for row in rows)
    run.finish({**content, **facts, **evaluations}, f"{passed} of {len(rows)} views pass")
