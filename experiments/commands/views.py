"""Random views of models and of analytic fields against the cautious reference."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from distrace.benchmarks.random_views import View
from distrace.checkpoints.model import Model, load_model
from distrace.cli.bench_views import Plan, bench_views
from distrace.cli.console import start
from experiments.fields.analytic import NAMES, analytic_views

SHARE = 5  # views of a model for each view of a family of analytic fields
DISTORTED = "sofas"  # the model whose first field the families distort


@dataclass(frozen=True)
class FieldPlan(Plan):
    """Adds the views of analytic fields."""

    def draw(self, models: Sequence[Model]) -> Iterator[View]:
        yield from super().draw(models)
        yield from analytic_views(load_model(DISTORTED).field(0), self.per_family, self.sizes, self.seed)

    def count(self) -> int:
        return super().count() + len(NAMES) * self.per_family

    @property
    def per_family(self) -> int:
        """The number of views of each family."""
        return -(-self.views // SHARE)


@dataclass(frozen=True)
class Views:
    """`distrace bench views` of the named models, and of analytic fields: steep, saturated, thin, tiny."""

    models: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[MODEL …]"), tyro.conf.Positional] = ()
    out: Path = Path("out/views")
    views: int = 60  # of each model, and a fifth as many of each family of fields
    sizes: tuple[int, int] = (128, 512)  # the smallest and the largest image, in pixels along each side
    strategy: str | None = None  # as in `distrace render`; by default that of `distrace.render`
    seed: int = 0
    references: Path | None = None  # a folder that keeps references, which take most of the time

    def run(self) -> None:
        plan = FieldPlan(self.models, self.views, self.sizes, self.seed, self.strategy, self.references)
        bench_views(start(self.out), plan)
