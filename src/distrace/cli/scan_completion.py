"""A completion in the frame of its input: the fit of code and placement, the mesh, the verdict, and the page."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from distrace import shading
from distrace.camera import Camera
from distrace.checkpoints.codes import save_code
from distrace.checkpoints.model import Model
from distrace.cli.common import Format, Orbit, finish_completion, save_meshes
from distrace.cli.console import Run, console, progress
from distrace.data.saved_scan import save_scan
from distrace.data.scan import Scan
from distrace.files import save_text
from distrace.fitting.fit_scan import ScanFit, ScanFitConfig, fit_scan
from distrace.fitting.judge import Verdict
from distrace.fitting.placement_network import PlacementNetwork
from distrace.mesh import MeshConfig, extract_mesh, mesh_in_world
from distrace.metrics import chamfer
from distrace.pose import Similarity
from distrace.prior import prior_of
from distrace.report.mesh_picture import mesh_picture
from distrace.report.scan_page import input_picture, scan_page

if TYPE_CHECKING:
    import trimesh

SIDE = 256  # pixels along the longer side of pictures
VIEWS = {
    "front": (0, 15),
    "back": (180, 15),
    "above": (30, 60),
}  # azimuth and elevation, of the object


@dataclass(frozen=True)
class ScanTask:
    """A scan to complete, and the settings."""

    model: Model
    network: PlacementNetwork | None  # of the model
    scan: Scan
    truth: "trimesh.Trimesh | np.ndarray | None"  # in the scan's frame
    mesh: MeshConfig
    seed: int
    formats: tuple[Format, ...]


def complete_scan(run: Run, task: ScanTask) -> Verdict:
    """Fits, and writes code, placement, meshes, pictures, page and `result.json`."""
    fit = _fitted(task)
    place = fit.place.to("cpu")
    save_code(run.out, fit.code, place)
    save_scan(run.out / "scan.npz", task.scan)
    shape = extract_mesh(task.model.field(fit.code), task.mesh)
    mesh = mesh_in_world(shape, place)
    save_meshes(run.out, mesh, task.formats)
    pictures = _pictures(task.scan, shape, place)
    shading.save_png(run.out / "shaded.png", next(iter(pictures.values())))
    with run.optional("report.html"):
        content = scan_page(
            verdict=fit.verdict,
            observed=[input_picture(*each) for each in zip(task.scan.images, task.scan.views)],
            pictures=pictures,
            mesh=mesh,
            points=task.scan.points.cpu().numpy(),
            losses=fit.losses,
            place=place,
            facts=_facts(task, fit),
            truth=task.truth,
            origin=run.origin,
        )
        save_text(run.out / "report.html", content)
    distances = None if task.truth is None else chamfer(_in_object(mesh, place), _in_object(task.truth, place))
    finish_completion(run, fit.verdict, fit.loss, fit.evaluations, distances)
    return fit.verdict


def _fitted(task: ScanTask) -> ScanFit:
    config = ScanFitConfig(seed=task.seed)
    prior = prior_of(task.model.codes)
    scan = task.scan.to(task.mesh.device)
    console.print(f"fitting {len(scan.points):,} points and {len(scan.free_until):,} rays of free space")
    if task.network is None:
        console.print(f"{task.model.name} has no placement network: twelve turns and two sizes are tried instead")
    with progress("fitting", config.total) as bar:
        return fit_scan(
            task.model.decoder, scan, prior, config, progress=lambda done: bar.advance(to=done), network=task.network
        )


def _pictures(scan: Scan, mesh: "trimesh.Trimesh", place: Similarity) -> dict[str, shading.Picture]:
    """Returns the completion in the object's frame, as the sensor sees it and from all sides."""
    cameras: dict[str, Camera] = {}
    for number, view in enumerate(scan.views):
        name = "the sensor" if len(scan.views) == 1 else f"sensor {number + 1}"
        cameras[name] = place.camera_in_object(view.camera.resized(min(1.0, SIDE / max(view.depth.shape))))
    for name, (azimuth, elevation) in VIEWS.items():
        cameras[name] = Orbit(azimuth=azimuth, elevation=elevation, size=SIDE).camera()
    return {name: mesh_picture(mesh, camera) for name, camera in cameras.items()}


def _in_object(shape: "trimesh.Trimesh | np.ndarray", place: Similarity) -> "trimesh.Trimesh | np.ndarray":
    """Returns a shape of the scan's frame in the unit sphere, where distances are measured."""
    inverse = np.linalg.inv(place.T_world_object.double().numpy())
    if isinstance(shape, np.ndarray):
        return shape @ inverse[:3, :3].T + inverse[:3, 3]
    return shape.copy().apply_transform(inverse)


def _facts(task: ScanTask, fit: ScanFit) -> dict[str, str]:
    scan = task.scan
    return {
        "points": f"{len(scan.points):,}",
        "rays of free space": f"{len(scan.free_until):,}",
        "noise of the points": f"{scan.noise:.2g}, in the input's unit",
        "diameter of the unit sphere": f"{2 * float(fit.place.scale):.4g}, in the input's unit",
        "evaluations of the network": f"{fit.evaluations:,}",
        "time of the fit": f"{fit.seconds:.0f} s on {task.mesh.device}",
        "seed": str(task.seed),
    }
