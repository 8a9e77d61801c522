"""The samples that `train` learns from; a folder of meshes is sampled first."""

import os
from collections.abc import Sequence
from pathlib import Path

from distrace.checkpoints.model import original
from distrace.cli.data import sampled
from distrace.data import sampling
from distrace.data.shapes import every_mesh, has_meshes, read_split

MESH_SAMPLES = 200_000  # of each mesh


def sample_files(given: Path, out: Path, splits: Sequence[Path] = ()) -> list[Path]:
    """Returns the files of a folder of samples, or of a folder of meshes, which are sampled below `out`.

    Samples lie in the folder itself, or below it as DeepSDF has them, in `SdfSamples/NAME/CLASS`. Splits restrict them
    to their training shapes. Raises `ValueError` where none remain.
    """
    folder = given / "SdfSamples" if (given / "SdfSamples").is_dir() else given
    paths = sorted(folder.glob("*.npz"))
    if not paths and has_meshes(folder):
        folder = _sampled_meshes(folder, out / "samples")
        paths = sorted(folder.glob("*.npz"))
    paths = paths or sorted(folder.rglob("*.npz"))
    if splits:
        learnt = {shape.name for split in splits for shape in read_split(split) if shape.split == "train"}
        names = learnt.union(split.stem for split in splits)  # procedural shapes are called sofas~1
        paths = [path for path in paths if original(path.stem) in names]
    if not paths:
        problem = "holds no samples (.npz) to learn" if folder.is_dir() else "is no folder of samples or meshes"
        raise ValueError(f"{folder} {problem}; `distrace sample` makes them")
    return paths


def _sampled_meshes(meshes: Path, out: Path) -> Path:
    """Samples every mesh below a folder, its mirror image and two warped copies; returns the folder of samples."""
    jobs = sampling.jobs(every_mesh(meshes), meshes, out, MESH_SAMPLES, mirror=True, variants=2)
    if not any(report.usable for report in sampled(jobs, os.cpu_count() or 1)):
        raise ValueError(f"no mesh in {meshes} bounds a solid; there is nothing to learn")
    return out
