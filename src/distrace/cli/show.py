"""`render` and `mesh`: images and meshes of a model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

from distrace.antialiasing import Style
from distrace.camera import Camera
from distrace.checkpoints.codes import named_code
from distrace.checkpoints.colours import named_albedo
from distrace.cli.common import (
    CodeName,
    Flag,
    Format,
    ModelName,
    Orbit,
    check_formats,
    default,
    opened_for,
    save_buffers,
    save_meshes,
    save_pictures,
)
from distrace.cli.console import progress, start
from distrace.cli.style import parsed_style
from distrace.coloured import coloured_mesh
from distrace.data.observation import View as Observation
from distrace.data.observation import save_view
from distrace.fields.base import Counted
from distrace.mesh import MeshConfig, extract_mesh
from distrace.movie import filmed, save_gif, save_mp4, turntable
from distrace.optional import require
from distrace.render import STRATEGIES, Buffers, Config
from distrace.shading import Picture
from distrace.tracing.sphere_tracing import Outcome, Trace, TraceConfig


@dataclass(frozen=True)
class Tally:
    """The evaluations of one image, and how its rays ended."""

    evaluations: int
    setup_evaluations: int
    outcomes: dict[str, int]

    @staticmethod
    def of(trace: Trace) -> "Tally":
        outcomes = {outcome.name.lower(): int((trace.outcome == outcome).sum()) for outcome in Outcome}
        return Tally(trace.total_evaluations, trace.setup_evaluations, outcomes)

    @property
    def per_visible_pixel(self) -> float | None:
        """Evaluations; None where nothing is seen."""
        hits = self.outcomes["hit"]
        return self.evaluations / hits if hits else None


@dataclass(frozen=True)
class Render(Orbit):
    """Render one view: depth, normals, mask and a shaded picture.

    They are written as PNGs and as arrays; with --orbit also a movie.
    """

    model: tyro.conf.Positional[ModelName]
    out: Path = Path("out/render")
    code: CodeName = "0"
    orbit: Annotated[int | None, default("no movie", "INT")] = None
    """frames of a movie (MP4 and GIF) that turns once around the vertical axis"""
    strategy: Literal["parallel", "dynamic", "aggressive", "coarse_to_fine", "fast"] = "fast"
    """fast is distrace's tracer; the others are DIST's strategies"""
    steps: Annotated[int | None, default("the strategy's", "INT")] = None  # maximum for a ray; not for fast
    clearance: Flag = False  # also write the least distance on each ray that misses, at the cost of evaluations
    samples: int = 1  # rays along each side of a pixel, averaged in shaded.png, mask.png and the movie
    background: Annotated[str, tyro.conf.arg(metavar="white|transparent|R,G,B")] = "white"  # of shaded.png, the movie
    light: Annotated[str | None, default("over the camera's left shoulder", "AZIMUTH,ELEVATION")] = None
    """direction to the light in degrees, as the camera's"""
    colour: Annotated[str | None, default("clay", "own|SHAPE|FILE")] = None
    """draw shaded.png and the movie in the shape's own colours, another training shape's, or those of a colour.npy"""
    device: str = "cpu"

    def run(self) -> None:
        style = parsed_style(self.samples, self.background, self.light)
        if self.orbit is not None:
            require("--orbit", "av")
            if style.background is None:
                raise ValueError("--background transparent was given with --orbit; a movie needs a colour")
        run = start(self.out, self.device)
        camera = self.camera().to(run.device)
        cameras = [camera] if self.orbit is None else turntable(camera, self.orbit)
        model = opened_for(run, self.model)
        code = named_code(model, self.code)
        if self.colour is not None:
            style = replace(style, albedo=named_albedo(model, self.model, self.code, code, self.colour))
        field = model.field(code)
        counted = Counted(field)
        finer = Counted(field)  # of the further rays a pixel
        with torch.no_grad(), run.noticing():
            drawn = self._drawn(filmed(counted, cameras, config=self._config()), cameras, style, finer)
            tallies = (
                [Tally.of(first.trace) for first, _ in drawn]
                if self.orbit is None
                else _movie(run.out, drawn, self.orbit)
            )
        facts = _facts(tallies, counted.evaluations)
        if self.samples > 1:
            facts["sample_evaluations"] = finer.evaluations
        pixels = self.size * self.size * len(tallies)
        summary = f"{facts['outcomes']['hit']} of {pixels} pixels hit, {facts['evaluations']} evaluations"
        if self.orbit is not None:
            facts["frames"] = len(tallies)
            facts["evaluations_per_visible_pixel"] = [tally.per_visible_pixel for tally in tallies]
        run.finish({**facts, "strategy": self.strategy}, summary)

    def _drawn(
        self, views: Iterator[Buffers], cameras: Sequence[Camera], style: Style, sdf: Counted
    ) -> Iterator[tuple[Buffers, Picture]]:
        """Yields the views and their shaded pictures.

        Writes the pictures and arrays of the first, and an observation for other commands.
        """
        for number, (view, camera) in enumerate(zip(views, cameras)):
            shaded, mask = style.draw(sdf, view, camera, self._config())
            if number == 0:
                save_pictures(self.out, view, camera, shaded, mask)
                save_buffers(self.out / "buffers.npz", view, self.clearance)
                save_view(self.out / "view.npz", Observation(camera, view.depth, view.mask, view.normal))
            yield view, shaded

    def _config(self) -> Config:
        config = STRATEGIES[self.strategy]
        if self.steps is None:
            return config
        if not isinstance(config, TraceConfig):
            raise ValueError(
                f"--steps {self.steps} was given, and fast counts none; choose another --strategy, or omit --steps"
            )
        return replace(config, steps=self.steps)


def _movie(folder: Path, drawn: Iterator[tuple[Buffers, Picture]], frames: int) -> list[Tally]:
    """Writes the shaded views as a movie; returns the tally of each."""
    tallies: list[Tally] = []
    pictures: list[Picture] = []
    with progress("turning", frames) as bar:
        for view, shaded in drawn:
            tallies.append(Tally.of(view.trace))
            pictures.append(shaded)
            bar.advance(f"{tallies[-1].evaluations} evaluations")
    save_mp4(folder / "turntable.mp4", np.stack(pictures))
    save_gif(folder / "turntable.gif", np.stack(pictures))
    return tallies


def _facts(tallies: list[Tally], evaluations: int) -> dict[str, Any]:
    """Returns sums over all images; `evaluations` counts every point at which the field was evaluated."""
    traced = sum(tally.evaluations for tally in tallies)
    outcomes: dict[str, int] = {name: sum(tally.outcomes[name] for tally in tallies) for name in tallies[0].outcomes}
    return {
        "evaluations": traced,
        "setup_evaluations": sum(tally.setup_evaluations for tally in tallies),
        "gradient_evaluations": outcomes["hit"],  # the normals
        "clearance_evaluations": evaluations - traced - outcomes["hit"],
        "outcomes": outcomes,
    }


@dataclass(frozen=True)
class Mesh:
    """Extract a mesh by marching cubes."""

    model: tyro.conf.Positional[ModelName]
    out: Path = Path("out/mesh")
    code: CodeName = "0"
    resolution: int = 256  # cells along each side of the cube around the unit sphere
    format: tuple[Format, ...] = ("ply",)  # of the mesh, one or several
    colour: Annotated[str | None, default("none", "own|SHAPE|FILE")] = None  # colours of the vertices, as in `render`
    device: str = "cpu"

    def run(self) -> None:
        check_formats(self.format)
        run = start(self.out, self.device)
        model = opened_for(run, self.model)
        code = named_code(model, self.code)
        albedo = None if self.colour is None else named_albedo(model, self.model, self.code, code, self.colour)
        counted = Counted(model.field(code))
        with run.noticing():
            surface = extract_mesh(counted, MeshConfig(self.resolution, device=run.device))
        if albedo is not None:
            surface = coloured_mesh(surface, albedo, run.device)
        save_meshes(run.out, surface, self.format)
        evaluations = {"evaluations": counted.evaluations, "setup_evaluations": counted.evaluations}
        run.finish({**evaluations, "faces": len(surface.faces)}, f"{len(surface.faces)} faces")
