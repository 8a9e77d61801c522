"""Samples a folder of meshes in parallel; a run that was stopped resumes."""

import json
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from distrace.data.augmentation import lopsided, warped
from distrace.data.samples import Doubt, doubt, sample, write_samples
from distrace.data.shapes import Shape
from distrace.data.solid import Solid, load_solid, turned
from distrace.errors import error_context
from distrace.files import save_json
from distrace.processes import parallel_map


@dataclass(frozen=True)
class Job:
    """One shape to sample, with its variants."""

    shape: Shape
    mesh: Path
    out: Path
    count: int
    mirror: bool = False  # also its mirror image in x, where that is another shape
    variants: int = 0  # also as many copies warped at random

    def samples(self, variant: str = "") -> Path:
        return self.out / f"{self.shape.name}{variant}.npz"

    @property
    def report(self) -> Path:
        return self.samples().with_suffix(".json")

    def settings(self) -> dict[str, object]:
        """All that its samples depend on."""
        return {
            "mesh": f"{zlib.crc32(self.mesh.read_bytes()):08x}",
            "turn": self.shape.turn,
            "count": self.count,
            "mirror": self.mirror,
            "variants": self.variants,
        }


def jobs(shapes: list[Shape], meshes: Path, out: Path, count: int, mirror: bool, variants: int) -> list[Job]:
    """Returns the shapes to sample; only those to train on have variants."""
    found = []
    for shape in shapes:
        learnt = shape.split == "train"
        if shape.split != "out":
            found.append(Job(shape, meshes / shape.path, out, count, mirror and learnt, variants if learnt else 0))
    return found


def run(todo: list[Job], workers: int) -> Iterator[Doubt]:
    """Does the jobs and yields their reports, those of an earlier run first.

    Raises `ValueError` for a report that is damaged, or of another mesh or other settings.
    """
    reports = [_earlier(job) for job in todo]
    yield from (report for report in reports if report)
    yield from parallel_map(run_one, [job for job, report in zip(todo, reports) if not report], workers)


def run_one(job: Job) -> Doubt:
    """Writes the samples of a shape and its variants, and last its report.

    A mesh that cannot be read, or whose signs are beyond hope, has a report that says why, and no samples.
    """
    if not job.mesh.is_file():
        missing = f"{job.mesh} is missing"  # not recorded: it may be there next time
        return Doubt(job.shape.name, 0, 0.0, 1.0, False, missing)
    try:
        solid = turned(load_solid(job.mesh), job.shape.turn)
    except ValueError as error:
        report = Doubt(job.shape.name, 0, 0.0, 1.0, False, str(error))
    else:
        report = doubt(job.shape.name, solid)
        if report.usable:
            _write(job, solid)
    save_json(job.report, {**asdict(report), "settings": job.settings()})
    return report


def _write(job: Job, solid: Solid) -> None:
    seed = zlib.crc32(job.shape.name.encode())
    samples = sample(solid, job.count, seed)
    write_samples(job.samples(), samples)
    if job.mirror and lopsided(solid):
        write_samples(job.samples("~mirrored"), samples * np.array([-1, 1, 1, 1], np.float32))
    random = np.random.default_rng(seed)
    for number in range(1, job.variants + 1):
        write_samples(job.samples(f"~warped{number}"), sample(warped(solid, random), job.count, seed + number))


def _earlier(job: Job) -> Doubt | None:
    if not job.report.exists() or not job.mesh.is_file():
        return None
    with error_context(f"{job.report} is not what `sample` leaves of a shape; remove it to sample the shape anew"):
        content = json.loads(job.report.read_text())
        before = dict(content.pop("settings"))
        report = Doubt(**content)
        if not report.is_of(job.shape.name):
            raise ValueError("its values are of other kinds, or of another shape")
    others = [name for name, value in job.settings().items() if before.get(name) != value]
    if others:
        raise ValueError(
            f"{job.out} has samples of {job.shape.name} with another {', '.join(others)}; give another --out"
        )
    return report if job.samples().exists() or not report.usable else None
