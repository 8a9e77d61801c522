"""`render` and `mesh`: looking at a model."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
import tyro

from distrace.camera import Camera
from distrace.cli.common import Flag, ModelName, opened, save_buffers, save_mesh, save_pictures
from distrace.cli.console import console, start
from distrace.field import Counted
from distrace.mesh import MeshConfig, extract_mesh
from distrace.render import STRATEGIES, Config
from distrace.render import render as render_field
from distrace.trace import Outcome, TraceConfig


@dataclass(frozen=True)
class Render:
    """Render one view: depth, normals, mask and a shaded picture, as PNGs and as arrays."""

    model: tyro.conf.Positional[ModelName]  # a bundled model, a DeepSDF experiment folder, or a run of `train`
    out: Path = Path("out/render")
    code: int = 0  # which training shape
    azimuth: float = 30.0  # degrees
    elevation: float = 20.0  # degrees
    distance: float = 4.97  # of the camera from the origin
    focal_mm: float = 60.0
    sensor_mm: float = 32.0
    size: int = 512  # pixels along each side
    strategy: Literal["parallel", "dynamic", "aggressive", "coarse_to_fine", "fast"] = "fast"
    steps: int | None = None  # at most, of every strategy but fast; as the strategy has it, if not given
    clearance: Flag = False  # also the least value of the field on each ray, which costs evaluations
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        camera = Camera.orbit(
            self.azimuth,
            self.elevation,
            self.distance,
            focal_mm=self.focal_mm,
            sensor_mm=self.sensor_mm,
            height=self.size,
            width=self.size,
        ).to(run.device)
        counted = Counted(opened(self.model, run.device).field(self.code))
        with torch.no_grad():
            buffers = render_field(counted, camera, config=self._config())
            save_pictures(run.out, buffers, camera)
            save_buffers(run.out / "buffers.npz", buffers, self.clearance)
        outcomes = {outcome.name.lower(): int((buffers.trace.outcome == outcome).sum()) for outcome in Outcome}
        console.print(
            f"{outcomes['hit']} of {self.size * self.size} pixels hit, {buffers.trace.total_evaluations} evaluations"
        )
        facts = {
            "evaluations": buffers.trace.total_evaluations,
            "setup_evaluations": buffers.trace.setup_evaluations,
            "gradient_evaluations": outcomes["hit"],  # the normals
            "clearance_evaluations": counted.evaluations - buffers.trace.total_evaluations - outcomes["hit"],
        }
        run.finish({**facts, "strategy": self.strategy, "outcomes": outcomes})

    def _config(self) -> Config:
        config = STRATEGIES[self.strategy]
        if self.steps is None:
            return config
        if not isinstance(config, TraceConfig):
            raise ValueError(
                f"--steps {self.steps} was given, and fast counts none; choose another --strategy, or no steps"
            )
        return replace(config, steps=self.steps)


@dataclass(frozen=True)
class Mesh:
    """Extract a mesh by marching cubes."""

    model: tyro.conf.Positional[ModelName]  # a bundled model, a DeepSDF experiment folder, or a run of `train`
    out: Path = Path("out/mesh")
    code: int = 0  # which training shape
    resolution: int = 256  # cells along each side of the cube around the unit sphere
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        counted = Counted(opened(self.model, run.device).field(self.code))
        surface = extract_mesh(counted, MeshConfig(self.resolution, device=run.device))
        save_mesh(run.out / "mesh.ply", surface)
        console.print(f"{len(surface.faces)} faces")
        evaluations = {"evaluations": counted.evaluations, "setup_evaluations": counted.evaluations}
        run.finish({**evaluations, "faces": len(surface.faces)})
