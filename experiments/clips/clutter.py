"""A cluttered background: coloured boxes beyond the cameras' orbit, and a patterned sky behind them."""

import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from distrace.data.patches import Patch

BOXES = 260
NEAREST = 7.0  # radii from the origin; cameras are at about 5
FARTHEST = 11.0
SIZES = (0.5, 2.0)  # of the edges, in radii
ELEVATIONS = (-75.0, 25.0)  # degrees: the background of cameras above the equator


def boxes(seed: int) -> Patch:
    """Returns random boxes; each face has a colour of its own."""
    random = np.random.default_rng(seed)
    corners = np.concatenate([_box(random) for _ in range(BOXES)])
    colours = random.uniform(0.3, 1.0, (len(corners) // 2, 3)).repeat(2, axis=0)  # a face is two triangles
    return Patch(corners, np.zeros((len(corners), 3, 2)), np.broadcast_to(colours[:, None], corners.shape))


def _box(random: np.random.Generator) -> Float[np.ndarray, "12 3 3"]:
    sines = np.sin(np.radians(ELEVATIONS))
    azimuth = random.uniform(0, 2 * np.pi)
    sine = random.uniform(*sines)
    level = np.sqrt(1 - sine**2)
    place = random.uniform(NEAREST, FARTHEST) * np.array([np.sin(azimuth) * level, sine, np.cos(azimuth) * level])
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    box = trimesh.creation.box(random.uniform(*SIZES, 3))
    order = np.argsort(np.round(box.face_normals) @ (1, 2, 4), kind="stable")  # the two halves of a face side by side
    return np.asarray(box.triangles)[order] @ rotation.T + place


def sky(seed: int, height: int = 256) -> UInt8[np.ndarray, "height width 3"]:
    """Returns a bright panorama of overlapping rectangles, twice as wide as high."""
    random = np.random.default_rng(seed)
    image = np.full((height, 2 * height, 3), 180, np.uint8)
    for _ in range(500):
        y, x = random.integers(0, (height, 2 * height))
        tall, wide = random.integers(height // 40, height // 6, 2)
        image[y : y + tall, x : x + wide] = random.integers(70, 255, 3)
    return image
