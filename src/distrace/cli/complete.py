"""`complete` and `demo`: a whole shape from one depth view, or from points."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import trimesh
import tyro

from distrace.cli.common import ModelName, opened
from distrace.cli.completion import Surface, Task, complete
from distrace.cli.console import console, start
from distrace.data.cloud import Cloud, load_cloud
from distrace.data.observation import View, load_view
from distrace.data.solid import load_geometry
from distrace.errors import explained
from distrace.fitting.continuation import CodeFitConfig
from distrace.fitting.fit import FitConfig
from distrace.mesh import MeshConfig

OBSERVATIONS = files("distrace") / "observations"
DEMO_POINTS = 100


@dataclass(frozen=True)
class Complete:
    """Complete a shape from one depth view, or from points of its surface: mesh, code, and a page that shows how."""

    model: tyro.conf.Positional[ModelName]  # a bundled model, a DeepSDF experiment folder, or a run of `train`
    observation: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OBSERVATION.npz")]]  # or POINTS.ply
    out: Path = Path("out/complete")
    reference: Path | None = None  # the true surface, to measure against: a mesh or points (PLY)
    points: int | None = None  # use only so many of the depths or points, drawn at random
    ignore: tuple[Literal["mask", "normal"], ...] = ()  # parts to leave out; a view's normals tell adam alone
    solver: Literal["lm", "adam"] = "lm"  # Levenberg–Marquardt, or Adam as in the original; points have lm alone
    iterations: int | None = None  # by default 16 of Levenberg–Marquardt, or 150 of Adam
    starts: int = FitConfig.starts
    plausible: int = 0  # so many other completions that fit, too, and how far they are apart
    seed: int = 0
    resolution: int = 128  # of the mesh: wings and rods thinner than its cells, a 64th, are torn; 256 keeps them
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        cloud = self.observation.suffix.lower() == ".ply"
        chosen = CodeFitConfig if self.solver == "lm" or cloud else FitConfig
        iterations = chosen.iterations if self.iterations is None else self.iterations
        fit = chosen(iterations=iterations, starts=self.starts, seed=self.seed)
        mesh = MeshConfig(self.resolution, device=run.device)
        if self.plausible < 0 or (self.points is not None and self.points < 1):
            given = f"--plausible {self.plausible} and --points {self.points}"
            raise ValueError(f"{given} were given; one cannot be negative, and at least one point is needed")
        full = load_cloud(self.observation) if cloud else load_view(self.observation)
        known = (full if self.points is None else full.sparse(self.points, self.seed)).without(*self.ignore)
        self._check(known, chosen)
        truth = None if self.reference is None else _reference(self.reference)
        complete(run, Task(opened(self.model, run.device), full, known, truth, fit, mesh, self.plausible))

    def _check(self, known: View | Cloud, chosen: type[CodeFitConfig | FitConfig]) -> None:
        """Raises `ValueError` where nothing that the solver uses is left."""
        if isinstance(known, View):
            used = known if chosen is FitConfig else known.without("normal")
            if not used.observed.any():
                left = f" without its {' and '.join(self.ignore)}" if self.ignore else ""
                raise ValueError(f"{self.observation}{left} has no depth and no mask of the object to complete it from")


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
        known = full.sparse(DEMO_POINTS, self.seed).without("normal")
        fit, mesh = CodeFitConfig(seed=self.seed), MeshConfig(128, device=run.device)
        complete(run, Task(opened("sofas", run.device), full, known, truth, fit, mesh))


def _reference(path: Path) -> Surface:
    with explained(f"{path} is no mesh and no cloud of points; give a PLY of the true surface", path):
        loaded = load_geometry(path)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry()
        vertices, faces = np.asarray(loaded.vertices, dtype=np.float64), getattr(loaded, "faces", ())
        if not len(vertices) or not np.isfinite(vertices).all():
            raise ValueError("it has no points, or some that are not finite")
        if len(faces) and not loaded.area > 0:
            raise ValueError("its faces have no area")
        return loaded if len(faces) else vertices
