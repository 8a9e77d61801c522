"""The results of `reconstruct`: mesh, page, film, figures and cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import numpy as np
import torch

from distrace.camera import Camera
from distrace.cli.common import Format, save_meshes
from distrace.cli.console import Run, device_name
from distrace.data.photo_readers.transforms import save_transforms
from distrace.data.photograph import Photograph
from distrace.data.unit_sphere import UnitSphere
from distrace.files import save_text
from distrace.mesh import MeshConfig, mesh_in_world
from distrace.movie import save_gif
from distrace.pose import exp_se3
from distrace.reconstruction.cameras import interpolated_step, moved, pixel_shift, registered
from distrace.reconstruction.state import ReconstructConfig, Reconstruction
from distrace.report.reconstruction_page import ComparedView, coloured_mesh, compared_view, reconstruction_page, row_of
from distrace.shading import grid, save_png

if TYPE_CHECKING:
    import trimesh

FITTED_SHOWN = 4  # views that were fitted to, on the page


@dataclass(frozen=True)
class Reconstructed:
    """A finished reconstruction and its photographs."""

    name: str
    state: Reconstruction
    config: ReconstructConfig
    unit_sphere: UnitSphere
    fitted_to: Sequence[Photograph]
    held_out: Sequence[Photograph]

    def save(self, run: Run, config: MeshConfig, formats: Sequence[Format]) -> None:
        """Writes the mesh in the folder's world, the page, the film and `result.json`."""
        mesh = coloured_mesh(self.state, config)
        held_out = self._judged(self.held_out)
        with run.optional("report.html"):
            self._save_page(run, mesh, held_out)
        if held_out:
            save_png(run.out / "held_out.png", grid([[view.picture] for view in held_out]))
        _save_film(run.out)
        save_meshes(run.out, mesh_in_world(mesh, self.unit_sphere.similarity), formats)
        rows = self._rows(held_out)
        refined = {
            view.name: replace(view.source, camera=camera)
            for view, camera in zip(self.fitted_to, self._refined_in_world, strict=True)
            if view.source is not None
        }
        save_transforms(run.out, refined)
        run.finish(
            {
                "rows": rows,
                "held_out": {
                    view.name: {"psnr": view.psnr, "silhouette_iou": view.silhouette_iou} for view in held_out
                },
                "unit_sphere": self.unit_sphere.described(),
                "cameras": self._cameras(),
                "steps": self.state.step,
                "evaluations": self.state.evaluations,
            },
            *map(_summary, rows),
        )

    @cached_property
    def _refined(self) -> list[Photograph]:
        """Returns the views that were fitted to, with their refined cameras."""
        return self._moved(self.fitted_to)

    @cached_property
    def _refined_in_world(self) -> list[Camera]:
        """Returns the refined cameras in the folder's world, in double where the views were read from files."""
        exact = [
            view if view.source is None else replace(view, camera=self.unit_sphere.camera_to_unit(view.source.camera))
            for view in self.fitted_to
        ]
        return [self.unit_sphere.camera_to_world(view.camera) for view in self._moved(exact)]

    def _moved(self, views: Sequence[Photograph]) -> list[Photograph]:
        """Returns the views that were fitted to, each with its camera's motion."""
        return [moved(*each) for each in zip(views, self.state.motions().detach().cpu(), strict=True)]

    @cached_property
    def _drifts(self) -> list[float]:
        """Returns by how many pixels each camera moved."""
        return [pixel_shift(*each) for each in zip(self.fitted_to, self._refined, strict=True)]

    def _judged(self, views: Sequence[Photograph]) -> list[ComparedView]:
        """Compares views with their renderings, in the size that was fitted last."""
        return [compared_view(self.state, view, self.config.sizes[-1]) for view in views]

    def _rows(self, held_out: Sequence[ComparedView]) -> list[dict[str, object]]:
        if not held_out:
            return []
        judgements = {
            "": held_out,
            "_corrected": self._judged([self._corrected(view) for view in self.held_out]),
            "_aligned": self._judged([registered(self.state, view, self.config) for view in self.held_out]),
        }
        method = "ours" if self.config.shape_from_colour else "hull"
        return [row_of(self.name, method, judgements, self.state.seconds)]

    def _corrected(self, view: Photograph) -> Photograph:
        """Returns the view with its camera moved as its neighbours' were; the photograph is not used."""
        steps = self.state.relative_steps.detach().cpu()
        eyes = torch.stack([each.camera.T_world_camera[:3, 3] for each in self.fitted_to])
        step = interpolated_step(steps, eyes, view.camera.T_world_camera[:3, 3])
        return moved(view, exp_se3(step[:3], step[3:]))

    def _save_page(self, run: Run, mesh: "trimesh.Trimesh", held_out: Sequence[ComparedView]) -> None:
        examples = self._judged(self._refined[:: -(-len(self._refined) // FITTED_SHOWN)])
        facts = {
            "views": f"{len(self.fitted_to)}, and {len(held_out)} held out",
            "steps": f"{self.state.step:,} of {self.config.rays} rays",
            "time of the steps": f"{self.state.seconds / 60:.0f} minutes on {device_name(run.device)}",
            "evaluations of the surface": f"{self.state.evaluations:,}",
            "shaped by": "colours and outlines" if self.config.shape_from_colour else "outlines",
            "cameras moved": f"by {median(self._drifts):.2f} pixels (median), {max(self._drifts):.2f} at most",
        }
        page = reconstruction_page(self.name, held_out, examples, self.state.loss_history, mesh, facts)
        save_text(run.out / "report.html", page)

    def _cameras(self) -> dict[str, object]:
        """Returns the refined cameras in the folder's world, and by how many pixels they moved."""
        return {
            view.name: {
                "pixels_moved": round(pixels, 3),
                "T_world_camera": camera.T_world_camera.tolist(),
            }
            for view, camera, pixels in zip(self._refined, self._refined_in_world, self._drifts, strict=True)
        }


def _summary(row: dict[str, object]) -> str:
    return (
        f"held-out views: {row['psnr']} dB, intersection over union {row['silhouette_iou']}; with their cameras"
        f" corrected as their neighbours' were {row['psnr_corrected']} dB, {row['silhouette_iou_corrected']};"
        f" registered {row['psnr_aligned']} dB, {row['silhouette_iou_aligned']}"
    )


def _save_film(folder: Path) -> None:
    """Writes the previews, one after the other, as a GIF."""
    from PIL import Image

    pictures = [np.asarray(Image.open(path).convert("RGB")) for path in sorted((folder / "previews").glob("*.png"))]
    if pictures:
        save_gif(folder / "forming.gif", np.stack(pictures))
