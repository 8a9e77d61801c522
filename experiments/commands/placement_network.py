"""Training of the networks that tell where to start a fit to a scan."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from distrace.cli.common import show_table
from distrace.cli.console import progress, start
from distrace.fitting.placement_network import PLACEMENT_FILE, save_placement_network
from experiments.datasets.splits import Meshes, on_side
from experiments.networks.scans import ScanMaker, TrainingScans, joined_scans
from experiments.networks.training import VALIDATION, trained, validated

SAVED_EVERY = 250  # scans


@dataclass(frozen=True)
class TrainPlacement:
    """Simulate scans of a class and train its placement network on them. The scans are kept for a second run."""

    category: tyro.conf.Positional[Literal["sofas", "chairs", "tables", "planes"]]
    meshes: Meshes = Path("out")
    out: Path | None = None  # by default out/placement-sofas and so on
    scans: int = 4500
    steps: int = 2000
    seed: int = 0

    def run(self) -> None:
        if self.scans <= VALIDATION or self.steps < 1:
            raise ValueError(
                f"--scans {self.scans} --steps {self.steps} were given; give over {VALIDATION}, and over 0"
            )
        run = start(self.out or Path("out") / f"placement-{self.category}")
        scans = self._scans(run.out / f"scans-{self.category}-{self.seed}.pt")
        with progress("steps", self.steps) as bar:
            network = trained(scans, self.steps, self.seed, lambda step: bar.advance(to=step))
        save_placement_network(run.out / PLACEMENT_FILE, network)
        row = {"class": self.category, "scans": self.scans, **validated(network, scans)}
        show_table([row])
        run.finish({"rows": [row]})

    def _scans(self, path: Path) -> TrainingScans:
        parts = [TrainingScans.load(path)] if path.is_file() else []
        done = sum(map(len, parts))
        maker = ScanMaker(self.category, on_side("train", self.category), self.meshes, self.seed)
        with progress("scans", self.scans) as bar:
            while done < self.scans:
                parts.append(maker.make(done))
                done += 1
                bar.advance(to=done)
                if done % SAVED_EVERY == 0 or done == self.scans:
                    parts = [joined_scans(parts)]
                    parts[0].save(path)
        return joined_scans(parts)[slice(0, self.scans)]
