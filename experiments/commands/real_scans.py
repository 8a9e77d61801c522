"""The table of completions of other people's scans, whose placement and true shape nobody knows."""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from distrace.cli.common import opened, show_table
from distrace.cli.console import console, origin, start
from distrace.cli.scan_completion import ScanTask, complete_scan
from distrace.data.scan_files import ScanOptions, load_scan
from distrace.mesh import MeshConfig

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
    out: Path = Path("out/real-scans")  # with a folder as `complete` writes it for each input
    resolution: int = 128
    seed: int = 0

    def run(self) -> None:
        run = start(self.out)
        rows = []
        for each in inputs(self.data):
            console.print(f"{each.name}, by {each.model}")
            rows.append(self._row(each))
        show_table(rows)
        run.finish({"rows": rows, "evaluations": sum(row["evaluations"] for row in rows), **origin()})

    def _row(self, given: Input) -> dict:
        """Completes an input, and returns what its `result.json` says."""
        run = start(self.out / given.name)
        began = time.process_time()
        with run.noticing():
            scan = load_scan(given.paths, given.options)
            model = opened(given.model, run.device)
            complete_scan(run, ScanTask(model, scan, None, MeshConfig(self.resolution), self.seed))
        facts = json.loads((run.out / "result.json").read_text())
        return {
            "input": given.name,
            "model": given.model,
            "verdict": facts["verdict"],
            "explained": facts["explained"],
            "blocked": facts["free_space_violated"],
            "seen": facts["extent_seen"],
            "seconds": round(facts["seconds"], 1),
            "processor_seconds": round(time.process_time() - began, 1),
            "evaluations": facts["evaluations"],
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
