"""Procedural shapes of a class."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from distrace.benchmarks.measuring import poster_view
from distrace.cli.console import progress, start
from distrace.data.solid import Solid, normalised
from distrace.files import atomic_write
from distrace.shading import grid, save_png
from experiments.datasets.pictured import pictured
from experiments.procedural import procedural_mesh

PREVIEWED = 32  # shapes
ACROSS = 8  # shapes in a row of the preview
TILE = 128  # pixels


@dataclass(frozen=True)
class Procedural:
    """Generate random shapes of a class, to train on besides real ones."""

    category: tyro.conf.Positional[Literal["sofas", "chairs", "tables", "planes"]]
    count: int = 240
    out: Path | None = None  # by default out/procedural-sofas and so on
    seed: int = 0

    def run(self) -> None:
        run = start(self.out or Path("out") / f"procedural-{self.category}")
        if self.count < 1:
            raise ValueError(f"--count {self.count} was given; at least one shape is needed")
        pictures = []
        with progress("shapes", self.count) as bar:
            for number in range(1, self.count + 1):
                mesh = procedural_mesh(self.category, np.random.default_rng([self.seed, number]))
                with atomic_write(run.out / f"{self.category}~{number}.ply") as part:
                    mesh.export(part, file_type="ply")
                if number <= PREVIEWED:
                    scaled = normalised(mesh)
                    pictures.append(pictured(Solid(scaled, scaled), poster_view(TILE)))
                bar.advance(str(number))
        save_png(run.out / "preview.png", grid([pictures[k : k + ACROSS] for k in range(0, len(pictures), ACROSS)]))
        run.finish({"class": self.category, "meshes": self.count, "seed": self.seed})
