"""Unpacks archives that a stranger may have made: plain files and folders are written, nothing is executed."""

import io
import shutil
import stat
import sys
import tarfile
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, BinaryIO

from distrace.errors import error_context

LIMIT = 4 << 30  # bytes

Member = tuple[str, int, bool, IO[bytes] | None]
"""Name, size, whether it is a plain file or folder, and the content; None of a folder."""


def unpack_deb(path: Path, folder: Path, limit: int = LIMIT, below: Sequence[str] = ()) -> None:
    """Writes the files of a Debian package, or those `below` some of its folders, under `folder`.

    Raises `ValueError` if `path` is not a whole .deb, or if one of them is neither file nor folder, would land
    outside `folder`, or brings the total above `limit` bytes; what was written before that stays.
    """
    with error_context(f"{path} cannot be unpacked as a Debian package; download the .deb again", path):
        _check_file(path)
        with path.open("rb") as handle:
            packed = _data_tar(handle, path.stat().st_size)
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            _write(_tar_members(archive, below), folder, limit)
            while archive.fileobj and archive.fileobj.read(1 << 20):
                pass  # the checksum of an xz or gz stream is compared only where it ends, behind the last member


def unpack_zip(path: Path, folder: Path, limit: int = LIMIT) -> None:
    """Writes the files of a zip under `folder`. Raises `ValueError` as `unpack_deb` does."""
    with error_context(f"{path} cannot be unpacked as a zip; download it again", path):
        _check_file(path)
        with zipfile.ZipFile(path) as archive:
            _write(_zip_members(archive), folder, limit)


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise ValueError("there is no such file")
    if path.stat().st_size == 0:
        raise ValueError("it is empty")


def _data_tar(handle: BinaryIO, size: int) -> bytes:
    """Returns the packed data.tar inside an `ar` container of `size` bytes (deb(5))."""
    if handle.read(8) != b"!<arch>\n":
        raise ValueError("it does not begin like one")
    while header := handle.read(60):
        if header[58:] != b"`\n":
            raise ValueError("it is damaged")
        name = header[:16].decode("ascii").rstrip(" /")
        length = int(header[48:58])
        if not 0 <= length <= size - handle.tell():
            raise ValueError("it is cut off")
        if name == "data.tar.zst" and sys.version_info < (3, 14):
            raise ValueError(f"its {name} needs Python 3.14 or one packed as .xz")
        if name.startswith("data.tar"):
            return handle.read(length)
        handle.seek(length + length % 2, io.SEEK_CUR)
    raise ValueError("it holds no data.tar")


def _tar_members(archive: tarfile.TarFile, below: Sequence[str]) -> Iterator[Member]:
    for entry in archive:
        if not below or any(PurePosixPath(entry.name).is_relative_to(folder) for folder in below):
            content = archive.extractfile(entry) if entry.isfile() else None
            yield entry.name, entry.size, entry.isfile() or entry.isdir(), content


def _zip_members(archive: zipfile.ZipFile) -> Iterator[Member]:
    for entry in archive.infolist():
        # Zips from systems without modes leave the kind at 0: then only the trailing slash tells folders.
        plain = stat.S_IFMT(entry.external_attr >> 16) in (0, stat.S_IFREG, stat.S_IFDIR)
        yield entry.filename, entry.file_size, plain, None if entry.is_dir() else archive.open(entry)


def _write(members: Iterable[Member], folder: Path, limit: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    total = 0
    for name, size, plain, content in members:
        total += size
        if total > limit:
            raise ValueError(f"it would unpack to more than {limit} bytes")
        if not plain:
            raise ValueError(f"its member {name!r} is neither a file nor a folder")
        target = _target(name, folder.resolve())
        (target if content is None else target.parent).mkdir(parents=True, exist_ok=True)
        if content is not None:
            with content, target.open("wb") as sink:
                shutil.copyfileobj(content, sink)


def _target(name: str, folder: Path) -> Path:
    """Returns where a member goes; Windows' rules are the stricter ones, so every system refuses the same names."""
    words = PureWindowsPath(name)
    target = (folder / name).resolve()
    if words.anchor or ".." in words.parts or not target.is_relative_to(folder):
        raise ValueError(f"its member {name!r} would land outside the folder")
    return target
