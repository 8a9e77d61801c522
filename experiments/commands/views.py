"""Random views of models and of analytic fields against the cautious reference."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from distrace.benchmarks.agreement import Reference
from distrace.benchmarks.random_views import RandomView
from distrace.checkpoints.model import Model, load_model
from distrace.cli.bench_views import Plan, bench_views
from distrace.cli.console import start
from distrace.errors import error_context
from distrace.files import save_arrays
from experiments.fields.analytic import NAMES, analytic_views

SHARE = 5  # views of a model for each view of a family of analytic fields
DISTORTED = "sofas"  # the model whose first field the families distort


@dataclass(frozen=True)
class FieldPlan(Plan):
    """Adds the views of analytic fields; keeps references, which take most of the time, between runs."""

    references: Path | None = None  # their folder

    def draw(self, models: Sequence[Model]) -> Iterator[RandomView]:
        yield from super().draw(models)
        yield from analytic_views(load_model(DISTORTED).field(0), self.per_family, self.sizes, self.seed)

    def reference(self, view: RandomView) -> Reference:
        """Reads the reference of a view, or computes and keeps it. Raises `ValueError` for a file that holds none."""
        path = self.references and self.references / f"{_digest(view)}.npz"
        if path and path.exists():
            with error_context(f"{path} holds no reference; delete it to compute it again"), np.load(path) as content:
                return torch.from_numpy(content["depth"]).to(view.device), float(content["seconds"])
        depth, seconds = super().reference(view)
        if path:
            save_arrays(path, {"depth": depth, "seconds": torch.tensor(seconds)})
        return depth, seconds

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


def _digest(view: RandomView) -> str:
    """Returns a hash of the camera, and of the field's values at 64 points."""
    points = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (64, 3))).float().to(view.device)
    with torch.no_grad():
        values = view.sdf(points).cpu().numpy().round(5)
    return sha256(f"{view.shot} {view.lipschitz} {values.tolist()}".encode()).hexdigest()[:24]
