"""`complete` and `demo`: a whole shape from one depth view, or from points."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from distrace.cli.common import ModelName, default, opened
from distrace.cli.completion import Task, complete
from distrace.cli.console import console, start
from distrace.data.cloud import Cloud, load_cloud
from distrace.data.observation import View, load_view
from distrace.data.solid import load_geometry
from distrace.errors import explained
from distrace.fitting.continuation import CodeFitConfig
from distrace.fitting.fit import FitConfig
from distrace.mesh import MeshConfig

if TYPE_CHECKING:
    import trimesh

OBSERVATIONS = files("distrace") / "observations"
DEMO_POINTS = 100


@dataclass(frozen=True)
class Complete:
    """Complete a shape from one depth view or a point cloud.

    Writes the mesh, the code, and a page that compares them with the observation.
    """

    model: tyro.conf.Positional[ModelName]  # a bundled model, a DeepSDF experiment folder, or a run of `train`
    observation: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OBSERVATION.npz")]]  # or POINTS.ply
    out: Path = Path("out/complete")
    reference: Annotated[Path | None, default("none", "PLY")] = None
    """true surface to measure against: a mesh or points (PLY)"""
    points: Annotated[int | None, default("all", "INT")] = None  # number of depths or points to use, drawn at random
    ignore: tuple[Literal["mask", "normal"], ...] = ()  # parts to ignore; only adam uses a view's normals
    solver: Literal["lm", "adam"] = "lm"  # Levenberg–Marquardt, or Adam as in DIST; clouds need lm
    iterations: Annotated[int | None, default("16 of lm, 150 of adam", "INT")] = None
    starts: int = FitConfig.starts  # of the multi-start fit
    plausible: int = 0  # number of other completions that also fit
    seed: int = 0
    resolution: int = 128  # cells along each side of the mesh's grid; 256 keeps parts thinner than 1/64 whole
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
    """Complete the bundled sofa, held out of training, from 100 depths and a mask."""

    out: Path = Path("out/demo")
    seed: int = 0
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        (name,) = (Path(item.name).stem for item in OBSERVATIONS.iterdir() if item.name.endswith(".npz"))
        full = load_view(Path(str(OBSERVATIONS / f"{name}.npz")))
        truth = _reference(Path(str(OBSERVATIONS / f"{name}.ply")))
        console.print(f"completing {name} from {DEMO_POINTS} depths and its silhouette")
        known = full.sparse(DEMO_POINTS, self.seed).without("normal")
        fit = CodeFitConfig(seed=self.seed)
        mesh = MeshConfig(128, device=run.device)
        complete(run, Task(opened("sofas", run.device), full, known, truth, fit, mesh))


def _reference(path: Path) -> "trimesh.Trimesh | np.ndarray":
    import trimesh

    with explained(f"{path} is no mesh and no cloud of points; give a PLY of the true surface", path):
        loaded: Any = load_geometry(path)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry()
        vertices = np.asarray(loaded.vertices, dtype=np.float64)
        faces = getattr(loaded, "faces", ())
        if not len(vertices) or not np.isfinite(vertices).all():
            raise ValueError("it has no points, or some that are not finite")
        if len(faces) and not loaded.area > 0:
            raise ValueError("its faces have no area")
        return loaded if len(faces) else vertices
