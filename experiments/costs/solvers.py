"""Adam against Levenberg–Marquardt: the loss of held-out shapes against time."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from distrace.benchmarks.measuring import poster_view
from distrace.checkpoints.model import Model
from distrace.data.observation import View
from distrace.data.shapes import Shape
from distrace.fields.decoder import Decoder
from distrace.fitting.fit import FitConfig, Step, fit_shape, view_terms
from distrace.fitting.fit_code import CodeFitConfig, fit_code
from distrace.fitting.ray_sampling import Pool
from distrace.mesh import MeshConfig, extract_mesh
from distrace.metrics import chamfer
from distrace.prior import Prior, prior_of
from experiments.datasets.solids import observe, solid_of
from experiments.tables.completion import OBSERVATION_SIZE

ADAM = FitConfig(iterations=200, starts=1)
BUDGETS = (2, 4, 8, 16, 24)  # iterations of Levenberg–Marquardt, each in a fit of its own
POINTS = (100,)  # observed depths; 0: all of them
RAYS = 1000  # with a depth, and as many of the silhouette, that measure the loss of every curve
RESOLUTION = 128  # of the meshes that are compared
EVERY = 20  # iterations of Adam between two measurements

Loss = Callable[[Float[Tensor, "length"]], float]


@dataclass(frozen=True)
class Curve:
    """The loss of a fit after some of its steps, and the seconds until then."""

    seconds: list[float]
    losses: list[float]
    evaluations: int  # of all steps
    code: Float[Tensor, "length"]

    def reached(self, loss: float) -> float | None:
        """Returns the seconds until the loss was reached, or None."""
        return next((t for t, value in zip(self.seconds, self.losses, strict=True) if value <= loss), None)


@dataclass(frozen=True)
class SolverRow:
    """A fit from the mean shape: its last loss, and the time to reach Adam's last loss, also relative to Adam's."""

    shape: str
    points: int  # observed; 0: every pixel's
    solver: str
    seconds: float
    loss: float
    reached: float | None
    ratio: float | None
    evaluations: int
    chamfer: float


def solver_rows(model: Model, shapes: list[Shape], meshes: Path, resolution: int) -> Iterator[tuple[SolverRow, Curve]]:
    """Yields each held-out shape, completed by both solvers from the depths of one view and its mask."""
    for shape in shapes:
        solid = solid_of(shape, meshes)
        full = replace(observe(solid, poster_view(OBSERVATION_SIZE)), normal=None)
        for points in POINTS:
            view = full.sparse(points, ADAM.seed) if points else full
            yield from compared(model, shape.name, points, view, solid.surface, resolution)


def compared(
    model: Model, shape: str, points: int, view: View, truth: trimesh.Trimesh, resolution: int
) -> Iterator[tuple[SolverRow, Curve]]:
    """Yields Adam first, since its last loss is the target of the other."""
    prior = prior_of(model.codes)
    loss = common_loss(model, view, prior)
    decoder = model.decoder
    adam = measured(fit_shape(decoder, [view], prior, ADAM), EVERY, loss)
    curves = {"adam": adam, "lm": measured_budgets(decoder, view, prior, loss)}
    for name, curve in curves.items():
        reached = curve.reached(adam.losses[-1])
        yield (
            SolverRow(
                shape,
                points,
                name,
                curve.seconds[-1],
                curve.losses[-1],
                reached,
                None if reached is None else reached / adam.seconds[-1],
                curve.evaluations,
                chamfer(extract_mesh(model.field(curve.code), MeshConfig(resolution)), truth).sum,
            ),
            curve,
        )


def common_loss(model: Model, view: View, prior: Prior) -> Loss:
    """Returns the loss of `fit_shape` on fixed rays."""
    targets = Pool.of(view).draw(RAYS, RAYS, torch.Generator().manual_seed(ADAM.seed + 1))

    @torch.no_grad()
    def loss(code: Float[Tensor, "length"]) -> float:
        w = prior.coordinates(code)
        terms = view_terms(model.field(code), [targets], ADAM)
        return float(torch.stack(list(terms.values())).sum() + ADAM.weights.code * w.square().mean())

    return loss


def measured_budgets(decoder: Decoder, view: View, prior: Prior, loss: Loss) -> Curve:
    """Returns the losses of `fit_code` from the mean shape, after each number of iterations."""
    configs = [CodeFitConfig(starts=1, iterations=count) for count in BUDGETS]
    fits = [fit_code(decoder, [view], prior, config) for config in configs]
    losses = [loss(fit.code) for fit in fits]
    return Curve([fit.seconds for fit in fits], losses, fits[-1].evaluations, fits[-1].code)


def measured(steps: Iterable[Step], every: int, loss: Loss) -> Curve:
    """Returns a fit's curve; its seconds exclude the measurement."""
    elapsed = 0.0
    evaluations = 0
    seconds: list[float] = []
    losses: list[float] = []
    code = torch.empty(0)
    for step in steps:
        elapsed += step.seconds
        evaluations += step.evaluations
        code = step.code
        if step.iteration % every == 0:
            seconds.append(elapsed)
            losses.append(loss(code))
    return Curve(seconds, losses, evaluations, code)
