"""Whether the files of a COLMAP model are whole: the records of binary ones are walked from one to the next.

COLMAP's own reader takes what is missing from a file that is cut off to be anything, and may read for ever. The format
is that of *Output format* in COLMAP's documentation; rigs and frames are those of COLMAP 3.12.
"""

from collections.abc import Callable
from pathlib import Path
from struct import error, unpack_from

Walk = Callable[[bytes, int], int]  # from the start of a record to its end


def check_whole(model: Path) -> None:
    """Raises `ValueError`, naming the file, where a `.bin` has fewer or more bytes than its records."""
    for name, step in RECORDS.items():
        path = model / f"{name}.bin"
        if path.is_file() and not _whole(path.read_bytes(), step):
            raise ValueError(f"{path} is cut off or damaged: its records do not end where the file does")


def with_point_lines(images: Path) -> str | None:
    """The text of images.txt with the lines of points that were dropped because they are empty; None if none was."""
    lines = [line for line in images.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    rows: list[str] = []
    for line, following in zip(lines, [*lines[1:], None]):
        rows.append(line)
        if _describes_image(line) and (following is None or _describes_image(following)):
            rows.append("")
    return None if rows == lines else "".join(f"{row}\n" for row in rows)


def _describes_image(line: str) -> bool:
    """Number, pose, camera and name; lines of points are numbers in threes."""
    words = line.split()
    return len(words) >= 10 and (len(words) % 3 != 0 or not words[-1].lstrip("-").isdecimal())


def _whole(content: bytes, step: Walk) -> bool:
    try:
        at = 8
        for _ in range(_count(content, 0)):
            at = step(content, at)
    except (error, ValueError, OverflowError):  # beyond the end; a name without one
        return False
    return at == len(content)


def _count(content: bytes, at: int, kind: str = "<Q") -> int:
    return unpack_from(kind, content, at)[0]


def _camera(content: bytes, at: int) -> int:
    """Number, model, width, height, parameters."""
    import pycolmap

    model = pycolmap.CameraModelId(_count(content, at + 4, "<i"))
    return at + 24 + 8 * len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params)


def _image(content: bytes, at: int) -> int:
    """Number, pose, camera, a name that ends in zero, and points: two coordinates and a number."""
    end = content.index(b"\0", at + 64) + 1
    return end + 8 + 24 * _count(content, end)


def _point(content: bytes, at: int) -> int:
    """Number, place, colour, error, and a track: an image and a point of it."""
    return at + 51 + 8 * _count(content, at + 43)


def _rig(content: bytes, at: int) -> int:
    """Number and sensors: kind and number, and of all but the first whether there is a pose, and it."""
    sensors = _count(content, at + 4, "<I")
    at += 16 if sensors else 8
    for _ in range(sensors - 1):
        at += 9 + 56 * (_count(content, at + 8, "<B") > 0)
    return at


def _frame(content: bytes, at: int) -> int:
    """Number, rig, pose, and what it holds: kind and number of a sensor, and a number."""
    return at + 68 + 16 * _count(content, at + 64, "<I")


RECORDS: dict[str, Walk] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
