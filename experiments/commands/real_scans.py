"""The table of completions of other people's scans, whose placement and true shape nobody knows."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

from distrace.checkpoints.codes import save_code
from distrace.checkpoints.model import load_model
from distrace.cli.common import Cluster, show_table
from distrace.cli.console import progress, start
from distrace.data.scan_inputs import ScanOptions, load_scan
from distrace.fitting.fit_scan import ScanFitConfig, fit_scan
from distrace.fitting.placement_network import load_placement_network
from distrace.mesh import MeshConfig, extract_mesh, mesh_in_world, save_mesh
from distrace.prior import prior_of
from distrace.processes import parallel_map
from experiments.commands.depth import checked

CHAIR = (360, 120, 570, 480)  # left, top, right, bottom of the chair in the depth image of the first frame
FRAMES = ("000090", "000000", "000030", "000060", "000120")
CLOUDS = {"pcn_airplane": "planes", "pcn_chair": "chairs", "pointr_airplane": "planes", "pointr_sofa": "sofas"}


@dataclass(frozen=True)
class Input:
    """Files of one object, and what a user says about them."""

    name: str
    model: str
    paths: tuple[Path, ...]
    options: ScanOptions = ScanOptions()


@dataclass(frozen=True)
class RealScans:
    """Complete a chair from one depth image of a real kitchen and from five, and four partial clouds."""

    data: tyro.conf.Positional[Path]  # a folder with kitchen_rgbd (7-Scenes) and partial_clouds (PCN, PoinTr)
    out: Path = Path("out/real-scans")  # with a folder of each input: mesh, code and placement
    resolution: int = 128  # of the meshes
    seed: int = 0
    jobs: int = 1  # processes; times are those of one at a time
    cluster: Cluster = None  # of Ray, instead of these processes

    def run(self) -> None:
        checked(self.jobs, None)
        run = start(self.out)
        given = list(inputs(self.data))
        work = partial(completed, run.out, self.resolution, self.seed)
        rows = []
        with progress("real scans", len(given)) as bar:
            alone = self.jobs == 1 and self.cluster is None
            for row in map(work, given) if alone else parallel_map(work, given, self.jobs, self.cluster):
                rows.append(row)
                bar.advance(f"{row['input']}: {row['verdict']}")
        names = [each.name for each in given]
        rows.sort(key=lambda row: names.index(row["input"]))
        show_table(rows)
        run.finish({"rows": rows, "evaluations": sum(row["evaluations"] for row in rows)})


def completed(out: Path, resolution: int, seed: int, given: Input) -> dict:
    """Completes an input, writes its mesh, and returns its row."""
    scan = load_scan(given.paths, given.options)
    model = load_model(given.model)
    network = load_placement_network(given.model)
    fit = fit_scan(model.decoder, scan, prior_of(model.codes), ScanFitConfig(seed=seed), network=network)
    mesh = mesh_in_world(extract_mesh(model.field(fit.code), MeshConfig(resolution)), fit.place)
    folder = start(out / given.name).out
    save_code(folder, fit.code, fit.place)
    save_mesh(folder / "mesh.ply", mesh)
    verdict = fit.verdict
    return {
        "input": given.name,
        "model": given.model,
        "verdict": verdict.name,
        "explained": round(verdict.explained, 3),
        "blocked": round(verdict.blocked, 3),
        "seen": round(verdict.seen, 3),
        "seconds": round(fit.seconds, 1),
        "evaluations": fit.evaluations,
    }


def inputs(data: Path) -> Iterator[Input]:
    """Returns the inputs. The box about the chair was read off the image; all clouds have y up, the default."""
    kitchen = data / "kitchen_rgbd"
    intrinsics = str(kitchen / "camera-intrinsics.txt")
    for count in (1, len(FRAMES)):
        images = tuple(kitchen / f"frame-{frame}.depth.png" for frame in FRAMES[:count])
        poses = tuple(kitchen / f"frame-{frame}.pose.txt" for frame in FRAMES[:count])
        name = "kitchen-chair" if count == 1 else f"kitchen-chair-{count}-images"
        yield Input(name, "chairs", images, ScanOptions(intrinsics=intrinsics, box=CHAIR, poses=poses))
    for name, model in CLOUDS.items():
        yield Input(name, model, (data / "partial_clouds" / f"{name}.pcd",))
