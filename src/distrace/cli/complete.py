"""`complete` and `demo`: a whole shape from depths or points."""

import sys
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from distrace.checkpoints.model import model_folder
from distrace.cli.common import NONE, Cluster, Flag, Format, ModelName, default, opened_for
from distrace.cli.complete_folder import FolderJob, complete_each, inputs_in
from distrace.cli.completion import COMPLETED, Task, complete
from distrace.cli.console import Run, console, start
from distrace.cli.scan_completion import ScanTask, complete_scan
from distrace.data.cloud import Cloud, load_cloud
from distrace.data.mesh_files import load_geometry
from distrace.data.observation import View, is_canonical, load_view
from distrace.data.scan_inputs import CLOUDS, ScanOptions, assumed_up, load_scan
from distrace.data.segmented_view import check_count
from distrace.errors import error_context
from distrace.files import run_lock
from distrace.fitting.fit import FitConfig
from distrace.fitting.fit_code import CodeFitConfig
from distrace.fitting.judge import Verdict
from distrace.fitting.placement_network import load_placement_network
from distrace.mesh import MeshConfig

if TYPE_CHECKING:
    import trimesh

OBSERVATIONS = files("distrace") / "observations"
DEMO_POINTS = 100
FAILED = 3  # exit status of `--strict`


Axis = Literal["x", "y", "z", "-x", "-y", "-z", "unknown"]


@dataclass(frozen=True)
class Complete:
    """Complete a shape from a depth image, an observation or a point cloud, wherever the object is.

    Writes the mesh, the placement, the code, a verdict, and a page that shows them beside the input. Several images
    show one object in one world; --mask or --box marks it in the first.
    """

    model: tyro.conf.Positional[ModelName]  # a bundled model, a DeepSDF experiment folder, or a run of `train`
    inputs: tyro.conf.Positional[
        Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT …", help_behavior_hint="(required)")]
    ]
    """depth image (16-bit PNG in mm; NPY, EXR in m), OBSERVATION.npz, or cloud (PLY, PCD, XYZ); several of one kind:
    depth images with --poses, observations of one world, or clouds in one frame; or a folder, whose files show an
    object each"""
    out: Path = Path("out/complete")
    up: Annotated[Axis | None, default("about -y for a depth image, else y", "AXIS")] = None
    """axis of the input's frame that points up, or `unknown`"""
    intrinsics: Annotated[str | None, default("none", "K")] = None
    """of a depth image: fx,fy,cx,cy in pixels, or a file with a 3 × 3 matrix"""
    poses: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="POSE …", help_behavior_hint="(default: none)")] = ()
    """of each depth image: a file with the 4 × 4 matrix that maps its camera to the world, whose frame is then used"""
    mask: Annotated[Path | None, default("none", "PNG")] = None  # of the first image: white where the object is
    box: Annotated[tuple[int, int, int, int] | None, default("none", "LEFT TOP RIGHT BOTTOM")] = None
    """of the first image: pixels around the object; the floor and separate things in it are left out"""
    frame: Annotated[Literal["input", "canonical"] | None, default("canonical where an input says so", "FRAME")] = None
    """canonical: the object lies in the unit sphere, upright, turned as its class is"""
    reference: Annotated[Path | None, default("none", "PLY")] = None
    """true surface in the input's frame, to measure against: a mesh or points"""
    strict: Flag = False  # exit status 3 where the verdict is `failed`
    points: Annotated[int | None, default("all", "INT")] = None  # number of the object's points to use, at random
    seed: int = 0
    resolution: int = 128  # cells along each side of the mesh's grid; 256 keeps parts thinner than 1/64 whole
    format: Annotated[tuple[Format, ...], tyro.conf.arg(help_behavior_hint="(default: ply glb)")] = ()
    """of the mesh, besides ply and glb"""
    device: str = "cpu"
    ignore: Annotated[tuple[Literal["mask", "normal"], ...], NONE] = ()
    """canonical: parts to ignore; only adam uses a view's normals"""
    solver: Literal["lm", "adam"] = "lm"  # canonical: Levenberg–Marquardt, or Adam as in DIST; clouds need lm
    iterations: Annotated[int | None, default("16 of lm, 150 of adam", "INT")] = None  # canonical
    starts: Annotated[int | None, default("8 of lm, 3 of adam", "INT")] = None  # canonical: of the multi-start fit
    plausible: int = 0  # canonical: number of other completions that also fit
    jobs: Annotated[int | None, default("one a core", "INT")] = None  # processes for a folder's inputs
    cluster: Cluster = None
    """a Ray cluster that completes a folder's inputs; its machines see the same files"""

    def run(self) -> None:
        run = start(self.out, self.device)
        if len(self.inputs) == 1 and self.inputs[0].is_dir():
            self._folder(run, self.inputs[0])
            return
        if self.plausible < 0:
            raise ValueError(f"--plausible {self.plausible} was given; it cannot be negative")
        if self.points is not None and self.points < 1:
            raise ValueError(f"--points {self.points} was given; at least 1 is needed")
        mesh = MeshConfig(self.resolution, device=run.device)
        canonical = len(self.inputs) > 0 and all(map(is_canonical, self.inputs))
        frame = self.frame or ("canonical" if canonical else "input")
        self._refuse(frame)
        with run.noticing():
            verdict = self._canonical(run, mesh) if frame == "canonical" else self._placed(run, mesh)
        if self.strict and verdict.name == "failed":
            sys.exit(FAILED)

    def _folder(self, run: Run, folder: Path) -> None:
        """Completes each file of a folder into a folder of its name; a second run resumes."""
        for name in ("poses", "mask", "box", "reference"):
            if getattr(self, name) != getattr(type(self), name):
                raise ValueError(f"--{name} was given with the folder {folder}, whose files show an object each")
        if self.jobs is not None and self.jobs < 1:
            raise ValueError(f"--jobs {self.jobs} was given; at least one process is needed")
        if self.out.resolve() == folder.resolve():
            raise ValueError(f"--out {self.out} is the folder of the inputs; give another")
        alone = replace(self, jobs=None, cluster=None, strict=False)
        read = [path for path in sorted(model_folder(self.model).rglob("*")) if path.is_file()]
        if self.intrinsics is not None and Path(self.intrinsics).is_file():
            read.append(Path(self.intrinsics))
        jobs = []
        for path in inputs_in(folder):
            jobs.append(FolderJob(path, replace(alone, inputs=(path,), out=run.out / path.name), tuple(read)))
        with run_lock(run.out):
            failed = complete_each(run, jobs, self.jobs, self.cluster)
        if self.strict and failed:
            sys.exit(FAILED)

    @property
    def formats(self) -> tuple[Format, ...]:
        return (*COMPLETED, *self.format)

    def _refuse(self, frame: str) -> None:
        """Raises `ValueError` for options of the other frame, which would do nothing."""
        names = ("up", "intrinsics", "poses", "mask", "box")
        if frame == "input":
            names = ("ignore", "solver", "iterations", "starts", "plausible")
        for name in names:
            if getattr(self, name) != getattr(type(self), name):
                raise ValueError(f"--{name} was given, which --frame {frame} does not use; leave it out")

    def _placed(self, run: Run, mesh: MeshConfig) -> Verdict:
        scan = load_scan(self.inputs, ScanOptions(self.up, self.intrinsics, self.mask, self.box, self.poses))
        if self.points is not None:
            scan = scan.sparse(self.points, self.seed)
            check_count(len(scan.points))
        if self.up is None:
            console.print(f"up is taken to be {assumed_up(self.inputs)}; --up gives another axis")
        truth = None if self.reference is None else _reference(self.reference)
        model = opened_for(run, self.model)
        network = load_placement_network(self.model)
        return complete_scan(run, ScanTask(model, network, scan, truth, mesh, self.seed, self.formats))

    def _canonical(self, run: Run, mesh: MeshConfig) -> Verdict:
        if len(self.inputs) != 1:
            raise ValueError(f"{len(self.inputs)} inputs were given; give one, or --frame input, which takes several")
        path = self.inputs[0]
        cloud = path.suffix.lower() in CLOUDS
        if cloud and (self.solver == "adam" or self.ignore):
            raise ValueError(f"{path} is a cloud of points, which knows no --solver adam and no --ignore")
        chosen = CodeFitConfig if self.solver == "lm" else FitConfig
        iterations = chosen.iterations if self.iterations is None else self.iterations
        starts = chosen.starts if self.starts is None else self.starts
        fit = chosen(iterations=iterations, starts=starts, seed=self.seed)
        full = load_cloud(path) if cloud else load_view(path, self.ignore)
        known = full if self.points is None else full.sparse(self.points, self.seed)
        self._check(path, known, chosen)
        truth = None if self.reference is None else _reference(self.reference)
        task = Task(opened_for(run, self.model), full, known, truth, fit, mesh, self.plausible, self.formats)
        return complete(run, task)

    def _check(self, path: Path, known: View | Cloud, chosen: type[CodeFitConfig | FitConfig]) -> None:
        """Raises `ValueError` where nothing that the solver uses is left."""
        if isinstance(known, View):
            used = known if chosen is FitConfig else known.without("normal")
            if not used.observed.any():
                left = f" without its {' and '.join(self.ignore)}" if self.ignore else ""
                raise ValueError(f"{path}{left} has no depth and no mask of the object to complete it from")


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
        complete(run, Task(opened_for(run, "sofas"), full, known, truth, fit, mesh))


def _reference(path: Path) -> "trimesh.Trimesh | np.ndarray":
    import trimesh

    with error_context(f"{path} is no mesh and no cloud of points; give a PLY of the true surface", path):
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
