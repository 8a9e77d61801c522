"""Movies: one field as many cameras see it, and pictures in a row as MP4 and as GIF."""

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from distrace.camera import Camera
from distrace.fields.base import SDF
from distrace.fields.batch import BatchField
from distrace.files import atomic_write
from distrace.optional import require
from distrace.render import Buffers, Config, render
from distrace.tracing.tracer import TracerConfig

Pictures = UInt8[np.ndarray, "frames height width 3"]

FRAME = Fraction(8, 100)  # seconds of each picture; a GIF counts in hundredths
BT709 = 1  # H.264's number for the colours, the curve and the matrix of HD television


def turntable(camera: Camera, frames: int) -> list[Camera]:
    """Cameras in even steps around the world's vertical axis, anticlockwise from above, from the given one on.

    Raises `ValueError` for fewer than two frames.
    """
    if frames < 2:
        raise ValueError(f"an orbit of {frames} frames was given; a turn takes at least 2")
    return [camera.turned(360 * frame / frames) for frame in range(frames)]


def filmed(
    sdf: SDF | BatchField, cameras: Iterable[Camera], *, radius: float = 1.0, config: Config = TracerConfig()
) -> Iterator[Buffers]:
    """Renders a field as each camera sees it. All use the occupancy that the first image measures.

    Raises `ValueError` for a radius that is not positive.
    """
    occupancy = None
    for camera in cameras:
        buffers = render(sdf, camera, radius=radius, config=config, occupancy=occupancy)
        occupancy = buffers.occupancy
        yield buffers


def save_mp4(path: str | Path, pictures: Pictures) -> None:
    """Writes [frames, height, width, 3] as H.264 that browsers play.

    Its sides are even: odd ones get a white row below, a white column on the right. Raises `ValueError` for no picture.
    """
    require("a movie", "av")
    import av
    from av.video.reformatter import ColorRange, Colorspace

    _, height, width, _ = _not_empty(pictures).shape
    even = np.pad(pictures, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), constant_values=255)
    with atomic_write(path) as file:  # by its name: to bring the index to the front, the file is read again
        with av.open(file.name, "w", format="mp4", options={"movflags": "faststart"}) as movie:
            stream = movie.add_stream("libx264", rate=1 / FRAME, options={"crf": "18"})
            stream.height, stream.width = even.shape[1:3]
            stream.pix_fmt = "yuv420p"
            stream.color_range = ColorRange.MPEG
            stream.colorspace = stream.color_primaries = stream.color_trc = BT709
            for picture in even:
                image = av.VideoFrame.from_ndarray(picture, format="rgb24")
                image = image.reformat(  # to the colours that the stream says it has: players would guess otherwise
                    format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
                )
                movie.mux(stream.encode(image))
            movie.mux(stream.encode())


def save_gif(path: str | Path, pictures: Pictures) -> None:
    """Writes [frames, height, width, 3] in 256 colours chosen for all of them together; plays for ever.

    Pictures that equal the one before become one with it, shown for longer. Raises `ValueError` for no picture.
    """
    from PIL import Image

    _, _, width, _ = _not_empty(pictures).shape
    palette = Image.fromarray(pictures.reshape(-1, width, 3)).quantize()
    images = [Image.fromarray(picture) for picture in pictures]
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    with atomic_write(path) as file:
        first.save(file, format="GIF", save_all=True, append_images=others, duration=round(1000 * FRAME), loop=0)


def _not_empty(pictures: Pictures) -> Pictures:
    if not len(pictures):
        raise ValueError("no picture was given; a movie needs at least one")
    return pictures
