"""Simulated scans of random shapes of a class, whose placement is known: what placement networks train on."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.scan import Scan, scan_of_view
from distrace.data.shapes import Shape
from distrace.data.solid import Solid, normalised
from distrace.data.up import Up
from distrace.errors import error_context
from distrace.files import atomic_write
from distrace.fitting.placement_network import POINTS
from distrace.pixels import rectangle_around
from experiments.datasets.sensor import Scene, sensed
from experiments.datasets.solids import solid_of
from experiments.procedural import procedural_mesh

REAL_SHARE = 0.25  # of the scans show real training shapes, the others procedural ones
BOX_SHARE = 0.25  # of the scans have a rectangle instead of a mask
BOX_MARGIN = 6  # pixels, at most, to each side
REDUCTION = 2  # of the images, beside the sensor's
STREAM = 77  # of the random shapes; no other command draws from it


@dataclass(frozen=True)
class TrainingScans:
    """Scans and true placements, stacked; of each at most `POINTS` points and rays, repeated where there are fewer."""

    points: Float[Tensor, "b n 3"]
    origins: Float[Tensor, "b n 3"]
    directions: Float[Tensor, "b n 3"]
    until: Float[Tensor, "b n"]
    centre: Float[Tensor, "b 3"]
    radius: Float[Tensor, "b"]
    up: Float[Tensor, "b 3"]
    eye: Float[Tensor, "b 3"]
    rotation: Float[Tensor, "b 3 3"]
    translation: Float[Tensor, "b 3"]
    scale: Float[Tensor, "b"]

    def __len__(self) -> int:
        return len(self.radius)

    def __getitem__(self, index: Tensor | slice) -> "TrainingScans":
        return TrainingScans(*(getattr(self, field.name)[index] for field in fields(self)))

    def save(self, path: Path) -> None:
        with atomic_write(path) as file:
            torch.save({field.name: getattr(self, field.name) for field in fields(self)}, file)

    @staticmethod
    def load(path: Path) -> "TrainingScans":
        """Raises `ValueError` for a file that holds no scans."""
        with error_context(f"{path} holds no simulated scans; remove it", path):
            return TrainingScans(**torch.load(path, weights_only=True))


class ScanMaker:
    """Makes scans by their numbers; one that shows too little is made again."""

    def __init__(self, category: str, shapes: list[Shape], meshes: Path, seed: int) -> None:
        self.category = category
        self.shapes = shapes
        self.meshes = meshes
        self.seed = seed
        self.random = np.random.default_rng()  # of the scan that is made
        self.solids: dict[str, Solid] = {}

    def make(self, number: int) -> TrainingScans:
        """Returns one scan, stacked; the same number has always the same."""
        self.random = np.random.default_rng([self.seed, STREAM, number])
        while True:
            seed = int(self.random.integers(1 << 30))
            scene = sensed(self._solid(seed), seed, bool(self.random.integers(2)), REDUCTION)
            boxed = self.random.uniform() < BOX_SHARE
            if not scene.mask.any():
                continue
            mask = rectangle_around(scene.mask, self._margins) if boxed else scene.mask
            try:
                return _stacked(scan_of_view(scene.view, mask, Up.along("y"), boxed), scene, seed)
            except ValueError:  # hardly any pixel of the object has a depth
                continue

    def _solid(self, seed: int) -> Solid:
        if not self.shapes or self.random.uniform() >= REAL_SHARE:
            mesh = normalised(procedural_mesh(self.category, np.random.default_rng([STREAM, seed])))
            return Solid(mesh, mesh)
        shape = self.shapes[self.random.integers(len(self.shapes))]
        if shape.name not in self.solids:
            self.solids[shape.name] = solid_of(shape, self.meshes)
        return self.solids[shape.name]

    def _margins(self, _length: int) -> tuple[int, int]:
        """Returns by how many pixels a rectangle is too large, before and after."""
        before, after = self.random.integers(0, BOX_MARGIN + 1, 2)
        return int(before), int(after)


def _stacked(scan: Scan, scene: Scene, seed: int) -> TrainingScans:
    random = torch.Generator().manual_seed(seed)
    points = _repeated_rows(len(scan.points), random)
    rays = _repeated_rows(len(scan.free_until), random)
    return TrainingScans(
        scan.points[points][None],
        scan.free.origins[rays][None],
        scan.free.directions[rays][None],
        scan.free_until[rays][None],
        scan.centre[None],
        torch.tensor([scan.radius]),
        scan.ups[:1],
        scene.view.camera.T_world_camera[None, :3, 3].clone(),
        scene.place.rotation[None],
        scene.place.translation[None],
        scene.place.scale[None],
    )


def _repeated_rows(count: int, random: torch.Generator) -> Tensor:
    """Returns `POINTS` row numbers, of each row as often as of any other."""
    order = torch.randperm(count, generator=random)
    return order[torch.arange(POINTS) % count]


def joined_scans(parts: list[TrainingScans]) -> TrainingScans:
    """Returns scans one after the other."""
    return TrainingScans(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(parts[0])))
