"""A synthetic clip: its description, its cameras, and its folder.

The folder holds `clip.json` (the description, written first), `images/`, `truth/masks/`, `truth/depth/`, and
`views.json` (cameras, written last). Each file is written whole, so a stopped run can resume.
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
from PIL import Image

from distrace.camera import Camera
from distrace.data.shapes import Shape
from distrace.errors import error_context
from distrace.files import atomic_write, save_json
from distrace.shading import Picture, save_png
from experiments.datasets.splits import on_side

Background = Literal["plain", "cluttered"]
Texture = Literal["own", "procedural"]  # the mesh's images; or noise over its colours
FOCAL_MM = 60.0
SENSOR_MM = 32.0
DISTANCE = 4.97  # from which the whole unit sphere is in view
LOWEST = 10.0  # degrees of elevation
HIGHEST = 35.0
SWAYS = 2  # of the elevation per turn
LEAST_SIZE = 16


@dataclass(frozen=True)
class Clip:
    """Everything that the images depend on, and the mesh's creator and licence."""

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
    seed: int = field(init=False)  # of noise and clutter, a hash of the shape's name

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", zlib.crc32(self.shape.encode()))

    @property
    def cameras(self) -> list[Camera]:
        """Returns cameras once around the shape, in equal steps of azimuth."""
        return [self._camera(frame / self.frames) for frame in range(self.frames)]

    def _camera(self, turn: float) -> Camera:
        elevation = (LOWEST + HIGHEST) / 2 + (HIGHEST - LOWEST) / 2 * math.sin(2 * math.pi * SWAYS * turn)
        lens = {"focal_mm": FOCAL_MM, "sensor_mm": SENSOR_MM, "height": self.size, "width": self.size}
        return Camera.orbit(360 * turn, elevation, DISTANCE, **lens, dtype=torch.float64)


def held_out(split: str, name: str) -> Shape:
    """Returns a held-out shape. Raises `ValueError`, with the valid names, for another name."""
    shapes = on_side("test", split)
    for shape in shapes:
        if shape.name == name:
            return shape
    names = ", ".join(shape.name for shape in shapes) or "none"
    raise ValueError(f"{name} is no held-out shape of {split}; they are {names}")


def check(frames: int, size: int, samples: int) -> None:
    """Raises `ValueError` for numbers that make no clip."""
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
    with error_context(f"{path} cannot be read; move it or choose another --out"):
        content = dict(json.loads(path.read_text(encoding="utf-8")))
    different = [f"{name} {content.get(name)}" for name, value in asdict(clip).items() if content.get(name) != value]
    if different:
        raise ValueError(f"{folder} holds another clip ({', '.join(different)}); choose another --out")


def missing(folder: Path, clip: Clip) -> list[int]:
    """Returns the frames without an image; a frame's image is written after its truth."""
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
    """Writes the image, and in `truth/` the mask (255 is the shape) and the depth z, `inf` on the background."""
    with atomic_write(folder / f"truth/depth/{frame:03d}.npy") as file:
        np.save(file, depth)
    with atomic_write(folder / f"truth/masks/{frame:03d}.png") as file:
        Image.fromarray(mask.astype(np.uint8) * 255).save(file, "PNG")
    save_png(folder / image_name(frame), image)


def save_views(folder: Path, clip: Clip) -> None:
    """Writes `views.json`, each image with its camera and the unit sphere, unless it exists."""
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
