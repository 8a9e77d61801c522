"""`complete` and `demo`: a whole shape from one depth view."""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import trimesh
import tyro

from distrace import report, shading
from distrace.checkpoint import Model
from distrace.cli.common import ModelName, opened, save_mesh
from distrace.cli.console import Run, console, progress, start
from distrace.data.view import View, load_view
from distrace.errors import explained
from distrace.files import written
from distrace.fit import FitConfig, fit_shape
from distrace.fit_code import CodeFitConfig, fit_code
from distrace.mesh import MeshConfig, extract_mesh
from distrace.metrics import Chamfer, chamfer
from distrace.prior import prior_of
from distrace.render import render
from distrace.starts import Step

OBSERVATIONS = files("distrace") / "observations"
DEMO_POINTS = 100


Surface = trimesh.Trimesh | np.ndarray


@dataclass(frozen=True)
class Task:
    """What is to be completed, and how."""

    model: Model
    full: View  # all that was observed
    known: View  # what may be used of it
    truth: Surface | None
    fit: FitConfig | CodeFitConfig
    mesh: MeshConfig


@dataclass(frozen=True)
class Outcome:
    """A fit, and everything that it took."""

    steps: list[Step]
    mesh: trimesh.Trimesh
    chamfer: Chamfer | None

    @property
    def evaluations(self) -> int:
        return sum(step.evaluations for step in self.steps)


@dataclass(frozen=True)
class Complete:
    """Complete a shape from one depth view: mesh, code, and a page that shows how."""

    model: tyro.conf.Positional[ModelName]  # a bundled model, a DeepSDF experiment folder, or a run of `train`
    observation: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OBSERVATION.npz")]]
    out: Path = Path("out/complete")
    reference: Path | None = None  # the true surface, to measure against: a mesh or points (PLY)
    points: int | None = None  # use only so many of the depths, drawn at random
    ignore: tuple[Literal["mask", "normal"], ...] = ()  # parts of the observation to leave out
    solver: Literal["adam", "lm"] = "adam"  # lm: Levenberg–Marquardt, in a fraction of the time
    iterations: int | None = None  # by default 150 of Adam, or 24 of Levenberg–Marquardt
    starts: int = FitConfig.starts
    seed: int = 0
    resolution: int = 128  # of the mesh
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        chosen = CodeFitConfig if self.solver == "lm" else FitConfig
        iterations = chosen.iterations if self.iterations is None else self.iterations
        fit = chosen(iterations=iterations, starts=self.starts, seed=self.seed)
        mesh = MeshConfig(self.resolution, device=run.device)
        full = load_view(self.observation)
        known = _known(full, self.points, self.ignore, self.seed)
        truth = None if self.reference is None else _reference(self.reference)
        _complete(run, Task(opened(self.model, run.device), full, known, truth, fit, mesh))


@dataclass(frozen=True)
class Demo:
    """Complete the bundled sofa, which the bundled model never saw, from 100 depths and its silhouette."""

    out: Path = Path("out/demo")
    seed: int = 0
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        (name,) = (Path(item.name).stem for item in OBSERVATIONS.iterdir() if item.name.endswith(".npz"))
        full = load_view(Path(str(OBSERVATIONS / f"{name}.npz")))
        truth = _reference(Path(str(OBSERVATIONS / f"{name}.ply")))
        console.print(f"completing [bold]{name}[/bold] from {DEMO_POINTS} depths and its silhouette")
        known = _known(full, DEMO_POINTS, ("normal",), self.seed)
        fit, mesh = FitConfig(seed=self.seed), MeshConfig(128, device=run.device)
        _complete(run, Task(opened("sofas", run.device), full, known, truth, fit, mesh))


def _known(full: View, points: int | None, ignore: tuple[str, ...], seed: int) -> View:
    if points is not None and points < 1:
        raise ValueError(f"--points {points} was given; at least one depth is needed")
    known = full if points is None else full.sparse(points, seed)
    return known.without(*ignore)


def _reference(path: Path) -> Surface:
    with explained(f"{path} is no mesh and no cloud of points; give a PLY of the true surface"):
        loaded: Any = trimesh.load(path, process=False)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry()
        return loaded if len(getattr(loaded, "faces", ())) else np.asarray(loaded.vertices, dtype=np.float64)


def _complete(run: Run, task: Task) -> None:
    outcome = _fitted(task)
    last = outcome.steps[-1]
    save_mesh(run.out / "mesh.ply", outcome.mesh)
    with written(run.out / "code.npy") as file:
        np.save(file, last.code.cpu().numpy())
    page = _story(task, outcome)
    shading.save_png(run.out / "shaded.png", page.after.shaded)
    with written(run.out / "report.html") as file:
        file.write(report.completion_page(page).encode())
    facts = {"loss": last.loss, "terms": last.terms, "start": last.start, "evaluations": outcome.evaluations}
    distances = outcome.chamfer
    if distances:
        console.print(f"Chamfer × 1000: {distances.to:.3f} to the true surface, {distances.from_:.3f} from it")
        facts |= {"chamfer_to": distances.to, "chamfer_from": distances.from_, "chamfer": distances.sum}
    run.finish({**facts, "setup_evaluations": 0})


def _fitted(task: Task) -> Outcome:
    steps: list[Step] = []
    with progress("fitting", task.fit.total) as bar:
        for step in _steps(task):
            steps.append(step)
            bar.advance(f"start {step.start + 1}, loss {step.loss:.4f}")
    mesh = extract_mesh(task.model.field(steps[-1].code), task.mesh)
    return Outcome(steps, mesh, None if task.truth is None else chamfer(mesh, task.truth))


def _steps(task: Task) -> Iterator[Step]:
    decoder, views, prior = task.model.decoder, [task.known], prior_of(task.model.codes)
    if isinstance(task.fit, CodeFitConfig):
        return fit_code(decoder, views, prior, task.fit)
    return fit_shape(decoder, views, prior, task.fit)


def _story(task: Task, outcome: Outcome) -> report.Completion:
    """All that the page shows."""
    known, full, truth, last = task.known, task.full, task.truth, outcome.steps[-1]
    losses: dict[str, list[float]] = {}
    for step in outcome.steps:
        losses.setdefault(f"start {step.start + 1}", []).append(step.loss)
    with torch.no_grad():
        codes = (prior_of(task.model.codes).mean, last.code)
        camera = full.camera.to(task.mesh.device)
        before, after = (report.View.of(render(task.model.field(code), camera)) for code in codes)
    facts = {
        "depths used": str(int(known.seen.sum())),
        "silhouette": "none" if known.mask is None else "used",
        "iterations": f"{task.fit.iterations}, after {task.fit.tried} of each of {task.fit.starts} starts",
        "evaluations of the network": f"{outcome.evaluations:,}",
        "time of the fit": f"{sum(step.seconds for step in outcome.steps):.0f} s on {task.mesh.device}",
        "seed": str(task.fit.seed),
    }
    return report.Completion(
        title="A shape completed from one depth view",
        observed_depth=known.depth.numpy(),
        observed_mask=None if known.mask is None else known.mask.numpy(),
        points_world=known.points().numpy(),
        before=before,
        after=after,
        truth=_truth_view(full) if full is not known else None,
        losses=losses,
        mesh=outcome.mesh,
        truth_points=truth.vertices if isinstance(truth, trimesh.Trimesh) else truth,
        chamfer=outcome.chamfer,
        facts=facts,
        chosen=f"start {outcome.steps[-1].start + 1}",
    )


def _truth_view(full: View) -> report.View | None:
    """What the observation holds beyond what was used, where it holds all of it."""
    if full.mask is None or full.normal is None or full.shaded is None:
        return None
    return report.View(full.depth.numpy(), full.normal.numpy(), full.mask.numpy(), full.shaded)
