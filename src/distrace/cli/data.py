"""`data` and `sample`: from packages of meshes to signed samples."""

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from distrace.cli.common import Flag
from distrace.cli.console import console, origin, progress, start
from distrace.data import furniture, planes, sampling
from distrace.data.catalogue import summary
from distrace.data.samples import Doubt
from distrace.data.shapes import every_mesh, read_split

PREPARED = {"furniture": furniture.prepare, "planes": planes.prepare, "parked-planes": planes.prepare_parked}


@dataclass(frozen=True)
class Data:
    """Fetch a source of meshes, unpack it, and list every mesh with its creator and licence."""

    name: tyro.conf.Positional[Literal["furniture", "planes", "parked-planes"]]
    """furniture: Debian's sweethome3d-furniture; planes: the aircraft of its flightgear-data-ai; parked-planes: those
    at the airports of its flightgear-data-base, of 1.3 GB"""
    out: Path | None = None  # by default out/furniture and so on
    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None  # the .deb, where apt-get is not at hand

    def run(self) -> None:
        run = start(self.out or Path("out") / self.name)
        meshes = PREPARED[self.name](run.out, self.source)
        console.print(summary(meshes), markup=False)
        if self.name == "furniture":
            console.print(f"{furniture.left_out(run.out)} models in other formats are left out")
        run.finish({"source": self.name, "meshes": len(meshes)})


@dataclass(frozen=True)
class Sample:
    """Turn meshes, watertight or not, into signed samples in DeepSDF's .npz; goes on where it was stopped."""

    meshes: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="MESHES")]]  # a folder, as `data` makes it
    out: Path = Path("out/samples")
    split: Path | None = None  # a CSV file that lists shapes; without one, every mesh below the folder
    count: int = 500_000  # samples of each shape
    mirror: Flag = False  # also the mirror image of training shapes that have another
    variants: int = 0  # also so many copies of each training shape, warped at random
    workers: int = os.cpu_count() or 1

    def run(self) -> None:
        run = start(self.out)
        if not self.meshes.is_dir():
            raise ValueError(
                f"{self.meshes} is no folder of meshes; `distrace data furniture --out {self.meshes}` makes one"
            )
        if self.count < 1000 or self.workers < 1 or self.variants < 0:
            given = f"--count {self.count} --workers {self.workers} --variants {self.variants}"
            raise ValueError(f"{given} was given; at least 1000, 1 and 0 are needed")
        shapes = read_split(self.split) if self.split else every_mesh(self.meshes)
        todo = sampling.jobs(shapes, self.meshes, self.out, self.count, self.mirror, self.variants)
        reports = sampled(todo, self.workers)
        rows = [asdict(report) for report in sorted(reports, key=lambda report: report.name)]
        usable = sum(report.usable for report in reports)
        run.finish({"shapes": usable, "left_out": len(reports) - usable, "rows": rows, **origin()})


def sampled(todo: list[sampling.Job], workers: int) -> list[Doubt]:
    """Does the jobs, and says which shapes are left out and why."""
    reports: list[Doubt] = []
    with progress("sampling", len(todo)) as bar:
        for report in sampling.run(todo, workers):
            reports.append(report)
            bar.advance(report.name)
            if not report.usable:
                console.print(f"left out {report.name}: {report.reason}", markup=False)
    return reports
