"""Buffers to pictures: pure functions from images to uint8 colours [height, width, 3] on a white background."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from distrace.files import atomic_write

Array = Tensor | np.ndarray
Picture = UInt8[np.ndarray, "_ _ 3"]  # of any size: some are larger than what they are drawn from
Rgba = UInt8[np.ndarray, "_ _ 4"]
Colour = tuple[int, int, int]

COLOUR_MAPS = ("viridis", "coolwarm")  # the rows of colour_maps.png, so that pictures need no matplotlib
WHITE: Colour = (255, 255, 255)
INK: Colour = (56, 64, 77)
# Distinct also to people with red-green colour blindness.
AGREE: Colour = (200, 206, 214)
MISSING: Colour = (226, 112, 32)
EXTRA: Colour = (44, 104, 190)
CLAY = np.array([0.60, 0.53, 0.46])  # linear light
GAMMA = 2.2  # of linear light to the values of pictures


def depth_picture(depth: Float[Array, "height width"], near: float | None = None, far: float | None = None) -> Picture:
    """Near is yellow and far is violet, evenly to the eye. Pictures of one range, near to far, can be compared."""
    values = _numpy(depth)
    finite = np.isfinite(values)
    least, most = depth_range(values)
    near, far = least if near is None else near, most if far is None else far
    nearness = (far - np.where(finite, values, far)) / max(far - near, 1e-12)
    return _over_white(_mapped("viridis", nearness), finite)


def depth_range(*depths: Float[Array, "..."]) -> tuple[float, float]:
    """The least and the greatest finite depth of several images; 0 and 1 where there is none."""
    values = np.concatenate([_numpy(depth).ravel() for depth in depths])
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)


def normal_picture(
    normal: Float[Array, "height width 3"],
    mask: Bool[Array, "height width"],
    T_world_camera: Float[Array, "4 4"] | None = None,
) -> Picture:
    """(n + 1) / 2 as red, green and blue; with a pose the normals are turned so that blue faces the camera.

    The axes are then right, up and towards the camera, as in most published pictures.
    """
    axes = np.eye(3) if T_world_camera is None else _numpy(T_world_camera)[:3, :3] * [1, -1, -1]
    return _over_white((_numpy(normal) @ axes + 1) / 2, _numpy(mask))


def colour_picture(image: Float[Array, "height width 3"]) -> Picture:
    """Red, green and blue from 0 to 1."""
    return np.rint(255 * np.clip(_numpy(image), 0, 1)).astype(np.uint8)


def mask_picture(mask: Bool[Array, "height width"]) -> Picture:
    return np.where(_numpy(mask)[..., None], INK, WHITE).astype(np.uint8)


def mask_comparison(observed: Bool[Array, "height width"], rendered: Bool[Array, "height width"]) -> Picture:
    """Where two masks agree, where the rendered one is missing, and where it is extra."""
    first, second = _numpy(observed)[..., None], _numpy(rendered)[..., None]
    colours = np.select([first & second, first, second], [np.array(c) for c in (AGREE, MISSING, EXTRA)], WHITE)
    return colours.astype(np.uint8)


def shaded_picture(
    normal: Float[Array, "height width 3"],
    mask: Bool[Array, "height width"],
    directions: Float[Array, "height width 3"],
    light: Float[np.ndarray, "3"] | None = None,
) -> Picture:
    """Clay in the light of a sky, a head lamp and a soft key light, with a slight rim.

    Normals and ray directions are in world axes, y up. `light` is the direction to the key light; by default it is
    over the camera's left shoulder.
    """
    n, towards = _numpy(normal).astype(float), -_numpy(directions).astype(float)
    facing = np.clip((n * towards).sum(-1), 0, 1)
    to_light = key_light(directions) if light is None else _unit(light)
    key = np.clip((n @ to_light + 0.25) / 1.25, 0, 1) ** 1.4  # wraps around the edge of the shadow
    sky = 0.5 + 0.5 * n[..., 1]
    rim = (1 - facing) ** 4 * sky
    brightness = 0.04 + 0.18 * sky + 0.20 * facing + 0.80 * key + 0.25 * rim
    return _over_white((brightness[..., None] * CLAY) ** (1 / GAMMA), _numpy(mask))


def mean_light(
    picture: Picture, mask: Bool[Array, "height width"], samples: int, background: Colour | None
) -> Picture | Rgba:
    """Averages `samples` × `samples` pixels to one in linear light, and puts a background where the mask is not.

    Without a background the picture is transparent there: the fourth channel is the share that the mask covers.
    """
    inside = _numpy(mask)[..., None].astype(float)
    light = _block_means(inside * (picture / 255) ** GAMMA, samples)
    coverage = _block_means(inside, samples)
    if background is None:
        colours = (light / np.maximum(coverage, 1e-12)) ** (1 / GAMMA)
        return np.rint(255 * np.concatenate([colours, coverage], axis=2)).astype(np.uint8)
    behind = (np.array(background) / 255) ** GAMMA
    return colour_picture((light + (1 - coverage) * behind) ** (1 / GAMMA))


def heat_picture(values: Float[Array, "height width"], mask: Bool[Array, "height width"]) -> Picture:
    """Values from 0, violet, to 1, yellow, within the mask; beyond they are cut off."""
    return _over_white(_mapped("viridis", np.clip(_numpy(values), 0, 1)), _numpy(mask))


def error_picture(difference: Float[Array, "height width"], limit: float) -> Picture:
    """A signed difference: blue is -limit, red is +limit, grey is none, white is where there is nothing to compare."""
    values = _numpy(difference)
    finite = np.isfinite(values)
    return _over_white(_mapped("coolwarm", np.where(finite, values, 0) / (2 * limit) + 0.5), finite)


def depth_difference(depth: Float[Array, "height width"], truth: Float[Array, "height width"]) -> np.ndarray:
    """Depth − truth; NaN where one of them is not finite."""
    first = _numpy(depth)
    second = _numpy(truth)
    both = np.isfinite(first) & np.isfinite(second)
    return np.subtract(first, second, out=np.full_like(first, np.nan), where=both)


def dots_picture(
    base: Picture, depth: Float[Array, "height width"], near: float | None = None, far: float | None = None
) -> Picture:
    """A faded picture of the same size, enlarged, and on it every pixel with a depth as a dot in the depth's colour."""
    from PIL import Image, ImageDraw

    scale = max(1, -(-600 // base.shape[1]))
    faded = Image.fromarray(255 - (255 - base) // 3).resize((base.shape[1] * scale, base.shape[0] * scale))
    canvas = faded.resize((2 * faded.width, 2 * faded.height))  # drawn at twice the size: PIL's edges are hard
    draw, radius = ImageDraw.Draw(canvas), canvas.width / 150
    colours = depth_picture(depth, near, far)
    for y, x in np.argwhere(np.isfinite(_numpy(depth))):
        centre = (2 * scale * (x + 0.5), 2 * scale * (y + 0.5))
        draw.circle(centre, radius, fill=tuple(colours[y, x].tolist()), outline=INK, width=2)
    return np.array(canvas.resize(faded.size, Image.Resampling.LANCZOS))


def side_by_side(pictures: Sequence[Picture], gap: int = 8) -> Picture:
    """Pictures in a row, their upper edges aligned."""
    return grid([pictures], gap)


def grid(rows: Sequence[Sequence[Picture]], gap: int = 8) -> Picture:
    """Rows of pictures, in cells as large as the largest picture."""
    pictures = [picture for row in rows for picture in row]
    if not pictures:
        raise ValueError("no picture was given; a grid needs at least one")
    height, width = (max(picture.shape[axis] for picture in pictures) + gap for axis in (0, 1))
    shape = (len(rows) * height - gap, max(len(row) for row in rows) * width - gap, 3)
    canvas = np.full(shape, 255, dtype=np.uint8)
    for i, row in enumerate(rows):
        for j, picture in enumerate(row):
            y, x = i * height, j * width
            canvas[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
    return canvas


def save_png(path: str | Path, picture: Picture | Rgba) -> None:
    """Writes a picture as PNG; the folder is made if it is missing."""
    from PIL import Image

    with atomic_write(path) as file:
        Image.fromarray(picture).save(file, format="PNG", optimize=True)


def key_light(directions: Float[Array, "height width 3"]) -> Float[np.ndarray, "3"]:
    """The direction to a light over the left shoulder of the camera of these rays.

    The camera's up is z, not y, where it looks straight down.
    """
    back = _unit(-_numpy(directions).astype(float).mean((0, 1)))
    up = np.array([0.0, 1.0, 0.0] if abs(back[1]) < 0.999 else [0.0, 0.0, 1.0])
    right = _unit(np.cross(up, back))
    return _unit(0.6 * back - 0.65 * right + 0.75 * np.cross(back, right))


def _block_means(image: Float[np.ndarray, "height width channels"], side: int) -> Float[np.ndarray, "_ _ channels"]:
    height, width, channels = image.shape
    return image.reshape(height // side, side, width // side, side, channels).mean((1, 3))


def _mapped(name: str, values: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width 3"]:
    """Returns the colours of values from 0 to 1 by one of matplotlib's colour maps."""
    levels = _colour_maps()[COLOUR_MAPS.index(name)]
    return levels[np.clip((values * len(levels)).astype(int), 0, len(levels) - 1)] / 255


@cache
def _colour_maps() -> UInt8[np.ndarray, "maps 256 3"]:
    from PIL import Image

    return np.array(Image.open(Path(__file__).with_name("colour_maps.png")))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _over_white(colours: Float[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]) -> Picture:
    """Colours from 0 to 1 within the mask, white elsewhere."""
    return colour_picture(np.where(mask[..., None], colours, 1))


def _numpy(image: Array) -> np.ndarray:
    return image.detach().cpu().numpy() if isinstance(image, Tensor) else image
