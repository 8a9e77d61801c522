"""A synthetic clip: what is filmed, from where, and the folder that it is kept in.

The folder holds `clip.json` (what it was made from, written first), `images/`, `truth/masks/` and `truth/depth/`, and
`views.json` (cameras, written last). Whatever of it is there is whole, so that a stopped run goes on where it was.
"""

import json
import math
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float

from distrace.camera import Camera
from distrace.data.pictures import save_mask
from distrace.data.shapes import Shape
from distrace.errors import explained
from distrace.files import save_json, written
from distrace.shading import Picture, save_png
from experiments.datasets.splits import on_side

Background = Literal["plain", "cluttered"]
Texture = Literal["own", "procedural"]  # of the mesh's maker; or a noise of ours over its plain colours
FOCAL_MM, SENSOR_MM, DISTANCE = 60.0, 32.0, 4.97  # all of the unit sphere is in view
LOWEST, HIGHEST = 10.0, 35.0  # degrees of elevation that the camera sways between
SWAYS = 2  # per turn
LEAST_SIZE = 16


@dataclass(frozen=True)
class Clip:
    """All that the images depend on, and whose mesh it is."""

    shape: str
    split: str
    background: Background
    frames: int
    size: int  # pixels, of both edges
    samples: int  # light paths per pixel
    texture: Texture
    mesh: str
    creator: str
    licence: str
    mitsuba: str
    seed: int = field(init=False)  # of noise and clutter: by the shape's name

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", zlib.crc32(self.shape.encode()))

    @property
    def cameras(self) -> list[Camera]:
        """Once around the shape, in equal steps of azimuth."""
        return [self._camera(frame / self.frames) for frame in range(self.frames)]

    def _camera(self, turn: float) -> Camera:
        elevation = (LOWEST + HIGHEST) / 2 + (HIGHEST - LOWEST) / 2 * math.sin(2 * math.pi * SWAYS * turn)
        lens = {"focal_mm": FOCAL_MM, "sensor_mm": SENSOR_MM, "height": self.size, "width": self.size}
        return Camera.orbit(360 * turn, elevation, DISTANCE, **lens, dtype=torch.float64)


def held_out(split: str, name: str) -> Shape:
    """Raises `ValueError`, with the names there are, where the split holds out no shape of that name."""
    shapes = on_side("test", split)
    for shape in shapes:
        if shape.name == name:
            return shape
    names = ", ".join(shape.name for shape in shapes) or "none"
    raise ValueError(f"{name} is no held-out shape of {split}; they are {names}")


def check(frames: int, size: int, samples: int) -> None:
    """Raises `ValueError` for what makes no clip."""
    if frames < 2:
        raise ValueError(f"--frames {frames} was given; a clip has at least 2")
    if size < LEAST_SIZE:
        raise ValueError(f"--size {size} was given; at least {LEAST_SIZE} pixels are needed")
    if samples < 1:
        raise ValueError(f"--samples {samples} was given; a pixel needs at least 1")


def begin(folder: Path, clip: Clip) -> None:
    """Writes `clip.json`. Raises `ValueError` where the folder holds another clip."""
    path = folder / "clip.json"
    if not path.exists():
        return save_json(path, asdict(clip))
    with explained(f"{path} cannot be read; move it or choose another --out"):
        kept = dict(json.loads(path.read_text(encoding="utf-8")))
    other = [f"{name} {kept.get(name)}" for name, value in asdict(clip).items() if kept.get(name) != value]
    if other:
        raise ValueError(f"{folder} holds another clip ({', '.join(other)}); choose another --out")


def missing(folder: Path, clip: Clip) -> list[int]:
    """The frames that are still to be rendered; a frame's image is written after its truth."""
    return [frame for frame in range(clip.frames) if not (folder / image_name(frame)).is_file()]


def image_name(frame: int) -> str:
    return f"images/{frame:03d}.png"


def save_frame(
    folder: Path,
    frame: int,
    image: Picture,
    mask: Bool[np.ndarray, "height width"],
    depth: Float[np.ndarray, "height width"],
) -> None:
    """The image, and in `truth/` the mask (255 is the shape) and the depth z in float32, `inf` where nothing is."""
    with written(folder / f"truth/depth/{frame:03d}.npy") as file:
        np.save(file, depth)
    save_mask(folder / f"truth/masks/{frame:03d}.png", torch.from_numpy(mask))
    save_png(folder / image_name(frame), image)


def save_views(folder: Path, clip: Clip) -> None:
    """`views.json`: each image with its camera, and the sphere that the shape is in. A second call writes nothing."""
    views = [
        {
            "image": image_name(frame),
            "intrinsics": camera.intrinsics.tolist(),
            "T_world_camera": camera.T_world_camera.tolist(),
        }
        for frame, camera in enumerate(clip.cameras)
    ]
    if not (folder / "views.json").exists():
        save_json(folder / "views.json", {"views": views, "unit_sphere": {"centre": [0, 0, 0], "radius": 1.0}})
