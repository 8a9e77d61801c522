"""A completion in the canonical frame: the fit, the mesh, the distance to the truth, the verdict, and the page."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace import shading
from distrace.antialiasing import smooth_outline
from distrace.camera import Camera
from distrace.checkpoints.codes import save_code
from distrace.checkpoints.model import Model
from distrace.cli.common import Format, Orbit, finish_completion, save_meshes
from distrace.cli.console import Run, progress
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.data.saved_scan import save_scan
from distrace.data.scan import canonical_scan
from distrace.files import save_text
from distrace.fitting.completing import complete_shape, posterior_codes, posterior_deviation
from distrace.fitting.fit import FitConfig
from distrace.fitting.fit_code import CodeFit, CodeFitConfig
from distrace.fitting.free_space import PRUNED_PIECES, pruned_mesh
from distrace.fitting.judge import Verdict, judged
from distrace.mesh import MeshConfig, save_mesh
from distrace.metrics import Chamfer, chamfer, iou
from distrace.pose import Similarity
from distrace.prior import prior_of
from distrace.render import render
from distrace.report import completion_page as report

if TYPE_CHECKING:
    import trimesh

COMPLETED: tuple[Format, ...] = ("ply", "glb")  # always written
CLOUD_SIZE = 256  # pixels along each side of the pictures of a cloud's completion
OTHERS_SIDE = 144  # pixels along each side of the pictures of other completions
SPREAD = 0.1  # distance between completions that is drawn in the fullest colour


@dataclass(frozen=True)
class Task:
    """An observation to complete, and the settings."""

    model: Model
    full: View | Cloud  # the whole observation
    known: View | Cloud  # the part that the fit may use
    truth: "trimesh.Trimesh | np.ndarray | None"
    fit: FitConfig | CodeFitConfig
    mesh: MeshConfig
    plausible: int = 0  # number of other completions
    formats: tuple[Format, ...] = COMPLETED

    @property
    def camera(self) -> Camera:
        """Returns the view's camera; clouds are shown from above and in front."""
        return Orbit(size=CLOUD_SIZE).camera() if isinstance(self.full, Cloud) else self.full.camera

    def surface(self, code: Float[Tensor, "length"]) -> "trimesh.Trimesh":
        return pruned_mesh(self.model.field(code), self.known, self.mesh)

    def shown(self, observation: View | Cloud) -> View:
        return observation.seen_from(self.camera) if isinstance(observation, Cloud) else observation


@dataclass(frozen=True)
class CompletionResult:
    """The result of a fit, and of the fits of other completions."""

    fit: CodeFit
    others: list[Float[Tensor, "length"]]  # codes
    mesh: "trimesh.Trimesh"
    chamfer: Chamfer | None
    evaluations: int  # of all fits


def complete(run: Run, task: Task) -> Verdict:
    """Fits, and writes mesh, placement, code, pictures, page and `result.json`."""
    with progress("fitting", task.fit.total) as bar:
        fit = complete_shape(task.model, task.known, task.fit, lambda done: bar.advance(to=done))
    save_code(run.out, fit.code, Similarity.identity())
    save_scan(run.out / "scan.npz", canonical_scan(task.known))
    outcome = _outcome(task, fit)
    save_meshes(run.out, outcome.mesh, task.formats)
    for number, code in enumerate(outcome.others, 1):
        save_mesh(run.out / f"plausible-{number}.ply", task.surface(code))
    content = replace(_page_content(task, outcome), origin=run.origin)
    shading.save_png(run.out / "shaded.png", content.after.shaded)
    with run.optional("report.html"):
        save_text(run.out / "report.html", report.completion_page(content))
    finish_completion(run, content.verdict, fit.loss, outcome.evaluations, outcome.chamfer)
    return content.verdict


def _outcome(task: Task, fit: CodeFit) -> CompletionResult:
    """Returns the surface and the other completions. Raises `ValueError` for a field without a zero."""
    others: list[Tensor] = []
    evaluations = fit.evaluations
    if task.plausible:
        config = task.fit if isinstance(task.fit, CodeFitConfig) else CodeFitConfig(seed=task.fit.seed)
        others, spent = posterior_codes(task.model, task.known, task.plausible, config)
        evaluations += spent
    mesh = task.surface(fit.code)
    if others and len(mesh.faces):
        vertices = torch.tensor(np.asarray(mesh.vertices), dtype=torch.float32, device=task.mesh.device)
        mesh.vertex_attributes["spread"] = posterior_deviation(task.model, others, vertices).cpu().numpy()
    return CompletionResult(fit, others, mesh, None if task.truth is None else chamfer(mesh, task.truth), evaluations)


def _page_content(task: Task, outcome: CompletionResult) -> report.Completion:
    """Returns everything that the page shows."""
    known = task.shown(task.known)
    full = task.shown(task.full)
    code = outcome.fit.code
    with torch.no_grad():
        codes = (prior_of(task.model.codes).mean, code)
        camera = task.camera.to(task.mesh.device)
        before, after = (report.RenderedView.of(render(task.model.field(code), camera), camera) for code in codes)
    points = task.known.points if isinstance(task.known, Cloud) else known.points()
    pruned = outcome.mesh.metadata.get(PRUNED_PIECES, 0)
    facts = {
        "points used": str(len(points)),
        "silhouette": "none" if known.mask is None else "used",
        "pieces removed from the mesh, where the view shows free space": str(pruned),
        "iterations": str(task.fit.total),
        "starts": str(task.fit.starts),
        "evaluations of the network": f"{outcome.evaluations:,}",
        "time of the fit": f"{outcome.fit.seconds:.0f} s on {task.mesh.device}",
        "seed": str(task.fit.seed),
    }
    sdf = task.model.field(code)
    overlap = None if known.mask is None else iou(torch.from_numpy(after.mask), known.mask)
    scan = canonical_scan(task.known).to(task.mesh.device)
    verdict = judged(scan, sdf, Similarity.identity().to(task.mesh.device), silhouette=overlap)
    return report.Completion(
        verdict=verdict,
        title=f"A shape completed from {'points' if isinstance(task.known, Cloud) else 'one depth view'}",
        observed_depth=known.depth.numpy(),
        observed_mask=None if known.mask is None else known.mask.numpy(),
        points_world=points.numpy(),
        before=before,
        after=after,
        truth=None if task.known is task.full else _truth_view(full),
        others=_other_pictures(task, outcome) if outcome.others else [],
        losses=outcome.fit.losses,
        mesh=outcome.mesh,
        truth_surface=task.truth,
        chamfer=outcome.chamfer,
        facts=facts,
        chosen=next(iter(outcome.fit.losses)),
    )


@torch.no_grad()
def _other_pictures(task: Task, outcome: CompletionResult) -> list[list[shading.Picture]]:
    """Returns two rows, from the camera and from behind: the spread of all completions, then each other one."""
    camera = task.camera.to(task.mesh.device)
    camera = camera.resized(OTHERS_SIDE / camera.height)
    model = task.model
    codes = outcome.others
    rows = []
    for eye in (camera, camera.turned(180.0)):
        buffers = render(model.field(outcome.fit.code), eye)
        distance = torch.full_like(buffers.depth, torch.nan)
        distance[buffers.mask] = posterior_deviation(model, codes, buffers.points)
        pictures = [smooth_outline(render(model.field(code), eye), eye) for code in codes]
        rows.append([shading.error_picture(distance.cpu().numpy(), SPREAD), *pictures])
    return rows


def _truth_view(full: View) -> report.RenderedView | None:
    """Returns the whole observation, or None where a part of it is missing."""
    if full.mask is None or full.normal is None or full.shaded is None:
        return None
    return report.RenderedView(full.depth.numpy(), full.normal.numpy(), full.mask.numpy(), full.shaded)
