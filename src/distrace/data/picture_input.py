"""Photographs of a folder, or the sharpest frames of a video, as upright copies of a common largest size."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from distrace.data.photo_readers.frames import images_in
from distrace.data.pictures import FORMATS, SIXTEEN_BIT
from distrace.data.structure_from_motion import JPEG_QUALITY, Picture
from distrace.errors import error_context
from distrace.files import atomic_write
from distrace.optional import require

if TYPE_CHECKING:
    from PIL import Image

EXIF_IFD = 0x8769
FOCAL_35MM = 0xA405  # FocalLengthIn35mmFilm
SHARPNESS_SIZE = 640  # pixels along the longer side of the image whose sharpness is measured

Advance = Callable[[], None]


def listed(folder: Path) -> list[Path]:
    """Returns the photographs of a folder. Raises `ValueError` where there is none."""
    found = images_in(folder)
    if not found:
        others = sorted({path.suffix for path in folder.iterdir() if path.is_file() and path.suffix})
        holds = f"; it holds {', '.join(others)}: convert these" if others else ""
        raise ValueError(f"{folder} holds no PNG or JPEG photographs{holds}")
    return found


def copied_photographs(paths: list[Path], out: Path, max_size: int, advance: Advance) -> list[Picture]:
    """Writes copies to `out/images`, and the alpha of those that have one to `out/masks`.

    COLMAP knows no orientation in EXIF, so the copies are upright. Raises `ValueError` for a file that is no picture.
    """
    copies = []
    for path, name in zip(paths, _names(paths)):
        image, focal = _read(path)
        suffix = ".png" if path.suffix.lower() == ".png" else ".jpg"
        copies.append(replace(_saved(image, out, name, suffix, max_size), focal_35mm=focal))
        advance()
    return copies


def copied_frames(video: Path, count: int, out: Path, max_size: int, advance: Advance) -> list[Picture]:
    """Writes the sharpest frame of each of `count` equal spans of a video to `out/images`.

    Raises `ValueError` for a file that is no video.
    """
    from PIL import Image

    copies = []
    for number, frame in sharpest_frames(video, count):
        copies.append(_saved(Image.fromarray(frame), out, f"frame{number:06d}", ".jpg", max_size))
        advance()
    return copies


def sharpest_frames(video: Path, count: int) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Yields number and picture of the sharpest frame in each of `count` equal spans; all frames of a short video."""
    require("reading a video", "av")
    with error_context(f"{video} is neither a folder of photographs nor a video that can be read", video):
        total = _frame_count(video)
        best: tuple[float, int, Any] | None = None
        span = 0
        for number, frame in enumerate(_decoded(video)):
            this = min(number * count // max(total, count), count - 1)
            if best is not None and this != span:
                yield best[1], _upright(best[2])
                best = None
            span = this
            sharp = sharpness(_grey(frame))
            if best is None or sharp > best[0]:
                best = (sharp, number, frame)
        if best is not None:
            yield best[1], _upright(best[2])


def sharpness(grey: Float[np.ndarray, "height width"]) -> float:
    """Returns the variance of the Laplacian: large where edges are sharp (Pech-Pacheco et al., ICPR 2000)."""
    middle = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * middle
    return float(laplacian.var())


def _frame_count(video: Path) -> int:
    """Returns the number of packets: it is exact where a header is not, and takes no decoding."""
    import av

    with av.open(str(video)) as container:
        return sum(packet.size > 0 for packet in container.demux(container.streams.video[0]))


def _decoded(video: Path) -> Iterator[Any]:
    import av

    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        yield from container.decode(stream)


def _grey(frame: Any) -> Float[np.ndarray, "height width"]:
    factor = min(1.0, SHARPNESS_SIZE / max(frame.width, frame.height))
    width, height = (max(3, round(factor * side)) for side in (frame.width, frame.height))
    return frame.to_ndarray(format="gray", width=width, height=height, interpolation="AREA").astype(np.float32)


def _upright(frame: Any) -> UInt8[np.ndarray, "height width 3"]:
    """Returns the picture as a player shows it: phones note how they were held."""
    return np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90)))


def _names(paths: list[Path]) -> list[str]:
    """Returns stems without spaces, at which COLMAP's lists break; numbered where two are the same."""
    stems = ["_".join(path.stem.split()) for path in paths]
    if len({stem.lower() for stem in stems}) == len(stems):
        return stems
    return [f"{number:04d}_{stem}" for number, stem in enumerate(stems)]


def _read(path: Path) -> "tuple[Image.Image, float | None]":
    """Returns a picture upright, in eight bits a channel, and its focal length in 35 mm terms."""
    from PIL import Image, ImageOps

    with error_context(f"{path} cannot be read as a PNG or JPEG image", path):
        with Image.open(path, formats=FORMATS) as file:
            focal = float(file.getexif().get_ifd(EXIF_IFD).get(FOCAL_35MM, 0)) or None
            image = ImageOps.exif_transpose(file)
            if image.mode in SIXTEEN_BIT:
                image = Image.fromarray((np.array(image) // 257).astype(np.uint8))
            return image.convert("RGBA" if image.has_transparency_data else "RGB"), focal


def _saved(image: "Image.Image", out: Path, name: str, suffix: str, max_size: int) -> Picture:
    from PIL import Image

    factor = min(1.0, max_size / max(image.size))
    if factor < 1:
        image = image.resize([round(factor * side) for side in image.size], Image.Resampling.LANCZOS)
    if image.mode == "RGBA":
        _save(image.getchannel("A").convert("RGB"), out / "masks" / f"{name}{suffix}")
        image = image.convert("RGB")
    _save(image, out / "images" / f"{name}{suffix}")
    return Picture(f"{name}{suffix}", image.height, image.width)


def _save(image: "Image.Image", path: Path) -> None:
    with atomic_write(path) as file:
        if path.suffix == ".png":
            image.save(file, format="PNG", compress_level=1)
        else:
            image.save(file, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
