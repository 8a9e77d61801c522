"""Sampling a folder of meshes: in parallel, going on where it was stopped."""

import json
import zlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from distrace.data.samples import Doubt, doubt, sample, write_report, write_samples
from distrace.data.solid import Solid, load_solid, turned
from distrace.data.split import Shape
from distrace.data.warp import lopsided, warped


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


def jobs(shapes: list[Shape], meshes: Path, out: Path, count: int, mirror: bool, variants: int) -> list[Job]:
    """The shapes to sample; only those to train on have variants."""

    def job(shape: Shape) -> Job:
        learnt = shape.split == "train"
        return Job(shape, meshes / shape.path, out, count, mirror and learnt, variants if learnt else 0)

    return [job(shape) for shape in shapes if shape.split != "out"]


def run(todo: list[Job], workers: int) -> Iterator[Doubt]:
    """Does the jobs and yields their reports, those of an earlier run first."""
    reports = [_earlier(job) for job in todo]
    yield from (report for report in reports if report)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        pending = [pool.submit(run_one, job) for job, report in zip(todo, reports) if not report]
        try:
            yield from (future.result() for future in as_completed(pending))
        finally:
            pool.shutdown(cancel_futures=True)


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
    write_report(job.samples().with_suffix(".json"), report)
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
    path = job.samples().with_suffix(".json")
    return Doubt(**json.loads(path.read_text())) if path.exists() else None
