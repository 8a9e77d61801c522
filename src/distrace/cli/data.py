"""`data` and `sample`: from packages of meshes to signed samples."""

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from distrace.cli.common import Flag, default
from distrace.cli.console import console, progress, start
from distrace.data import furniture, planes, sampling
from distrace.data.debian import catalogue_package, catalogue_summary
from distrace.data.samples import Doubt
from distrace.data.shapes import every_mesh, read_split
from distrace.optional import require

SOURCES = {
    "furniture": (furniture.PACKAGE, furniture.catalogue),
    "planes": (planes.PACKAGE, planes.catalogue),
    "parked-planes": (planes.PARKED_PACKAGE, planes.parked),
}


@dataclass(frozen=True)
class Data:
    """Fetch a source of meshes, and list each with its creator and licence."""

    name: tyro.conf.Positional[Literal["furniture", "planes", "parked-planes"]]
    """furniture: Debian's sweethome3d-furniture; planes: the aircraft of its flightgear-data-ai; parked-planes: those
    at the airports of its flightgear-data-base, of 1.3 GB"""
    out: Annotated[Path | None, default("out/NAME", "PATH")] = None
    source: Annotated[Path | None, default("fetched by apt-get", "DEB"), tyro.conf.arg(name="from")] = None

    def run(self) -> None:
        run = start(self.out or Path("out") / self.name)
        meshes = catalogue_package(*SOURCES[self.name], run.out, self.source)
        run.finish({"source": self.name, "meshes": len(meshes)}, catalogue_summary(meshes))


@dataclass(frozen=True)
class Sample:
    """Turn meshes into signed samples in DeepSDF's .npz.

    Meshes need not be watertight. A run that was interrupted continues when run again.
    """

    meshes: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="MESHES")]]  # a folder, as `data` makes it
    out: Path = Path("out/samples")
    split: Annotated[Path | None, default("every mesh", "CSV")] = None  # file that lists shapes
    count: int = 500_000  # samples of each shape
    mirror: Flag = False  # also sample mirror images of training shapes that are not symmetric
    variants: int = 0  # number of randomly warped copies of each training shape
    workers: int = os.cpu_count() or 1  # processes

    def run(self) -> None:
        run = start(self.out)
        if not self.meshes.is_dir():
            raise ValueError(f"{self.meshes} is no folder of meshes; `distrace data furniture --out DIR` makes one")
        if self.count < 1000 or self.workers < 1 or self.variants < 0:
            given = f"--count {self.count} --workers {self.workers} --variants {self.variants}"
            raise ValueError(f"{given} was given; at least 1000, 1 and 0 are needed")
        shapes = read_split(self.split) if self.split else every_mesh(self.meshes)
        jobs = sampling.jobs(shapes, self.meshes, self.out, self.count, self.mirror, self.variants)
        reports = sampled(jobs, self.workers)
        rows = [asdict(report) for report in sorted(reports, key=lambda report: report.name)]
        usable = sum(report.usable for report in reports)
        run.finish({"shapes": usable, "left_out": len(reports) - usable, "rows": rows})


def sampled(jobs: list[sampling.Job], workers: int) -> list[Doubt]:
    """Runs the jobs; prints which shapes are left out and why."""
    require("sampling meshes", "igl", "embreex")
    reports: list[Doubt] = []
    with progress("sampling", len(jobs)) as bar:
        for report in sampling.run(jobs, workers):
            reports.append(report)
            bar.advance(report.name)
            if not report.usable:
                console.print(f"left out {report.name}: {report.reason}")
    return reports
