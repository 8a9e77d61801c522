"""What `train` learns from: files of samples, or meshes that are sampled first."""

import os
from collections.abc import Sequence
from pathlib import Path

from distrace.checkpoints.model import original
from distrace.cli.data import sampled
from distrace.data import sampling
from distrace.data.shapes import every_mesh, has_meshes, read_split

MESH_SAMPLES = 200_000  # of each mesh


def sample_files(given: Path, out: Path, splits: Sequence[Path] = ()) -> list[Path]:
    """Files of a folder of samples, those of splits if any is named; of a folder of meshes, sampled below `out`.

    Samples lie in the folder itself, or below it as DeepSDF has them, in `SdfSamples/NAME/CLASS`.
    """
    folder = given / "SdfSamples" if (given / "SdfSamples").is_dir() else given
    paths = sorted(folder.glob("*.npz"))
    if not paths and has_meshes(folder):
        folder = _sampled_meshes(folder, out / "samples")
        paths = sorted(folder.glob("*.npz"))
    paths = paths or sorted(folder.rglob("*.npz"))
    if splits:
        learnt = {shape.name for split in splits for shape in read_split(split) if shape.split == "train"}
        wanted = learnt.union(split.stem for split in splits)  # procedural shapes are called sofas~1
        paths = [path for path in paths if original(path.stem) in wanted]
    if not paths:
        what = "holds no samples (.npz) to learn" if folder.is_dir() else "is no folder of samples or meshes"
        raise ValueError(f"{folder} {what}; `distrace sample` makes them")
    return paths


def _sampled_meshes(meshes: Path, out: Path) -> Path:
    """Every mesh below a folder sampled, with its mirror image and two warped copies."""
    todo = sampling.jobs(every_mesh(meshes), meshes, out, MESH_SAMPLES, mirror=True, variants=2)
    if not any(report.usable for report in sampled(todo, os.cpu_count() or 1)):
        raise ValueError(f"no mesh in {meshes} bounds a solid; there is nothing to learn")
    return out
