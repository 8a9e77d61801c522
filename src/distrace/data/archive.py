"""Unpacking archives that a stranger may have made: plain files and folders are written, nothing is executed."""

import io
import shutil
import stat
import sys
import tarfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, BinaryIO

from distrace.errors import explained

LIMIT = 4 << 30  # bytes


@dataclass(frozen=True)
class _Member:
    name: str
    size: int
    is_file: bool
    is_folder: bool
    open: Callable[[], IO[bytes] | None]


def unpack_deb(path: Path, folder: Path, limit: int = LIMIT, below: Sequence[str] = ()) -> None:
    """The files of a Debian package, or those `below` some of its folders, written under `folder`.

    Raises ValueError if `path` is not a whole .deb, or if one of them is neither file nor folder, would land
    outside `folder`, or brings the total above `limit` bytes; what was written before that stays.
    """
    with explained(f"{path} cannot be unpacked as a Debian package; download the .deb again", path):
        with _not_empty(path) as handle:
            packed = _data_tar(handle, path.stat().st_size)
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            wanted = (each for each in _tar_members(archive) if not below or _is_below(each.name, below))
            _write(wanted, folder, limit)
            _read_to_the_end(archive)


def unpack_zip(path: Path, folder: Path, limit: int = LIMIT) -> None:
    """The files of a zip, written under `folder`; raises ValueError as `unpack_deb` does."""
    sentence = f"{path} cannot be unpacked as a zip; download it again"
    with explained(sentence, path), _not_empty(path) as handle, zipfile.ZipFile(handle) as archive:
        _write(_zip_members(archive), folder, limit)


def _not_empty(path: Path) -> BinaryIO:
    if not path.is_file():
        raise ValueError("there is no such file")
    if path.stat().st_size == 0:
        raise ValueError("it is empty")
    return path.open("rb")


def _data_tar(handle: BinaryIO, size: int) -> bytes:
    """The packed data.tar inside an `ar` container of `size` bytes (deb(5))."""
    if handle.read(8) != b"!<arch>\n":
        raise ValueError("it does not begin like one")
    while header := handle.read(60):
        if len(header) < 60 or header[58:] != b"`\n":
            raise ValueError("it is damaged")
        name = header[:16].decode("ascii").rstrip(" /")
        length = int(header[48:58])
        if not 0 <= length <= size - handle.tell():
            raise ValueError("it is cut off")
        if name.startswith("data.tar"):
            _require_readable(name)
            return handle.read(length)
        handle.seek(length + length % 2, io.SEEK_CUR)
    raise ValueError("it holds no data.tar")


def _require_readable(name: str) -> None:
    if name.endswith(".zst") and sys.version_info < (3, 14):
        raise ValueError(f"its {name} needs Python 3.14 or one packed as .xz")


def _tar_members(archive: tarfile.TarFile) -> Iterator[_Member]:
    for entry in archive:
        content = partial(archive.extractfile, entry)
        yield _Member(entry.name, entry.size, entry.isfile(), entry.isdir(), content)


def _is_below(name: str, folders: Sequence[str]) -> bool:
    return any(PurePosixPath(name).is_relative_to(folder) for folder in folders)


def _read_to_the_end(archive: tarfile.TarFile) -> None:
    # The checksum of an xz or gz stream is compared only where it ends, behind the last member.
    while archive.fileobj is not None and archive.fileobj.read(1 << 20):
        pass


def _zip_members(archive: zipfile.ZipFile) -> Iterator[_Member]:
    for entry in archive.infolist():
        # Zips from systems without modes leave the kind at 0: then only the trailing slash tells folders.
        kind = stat.S_IFMT(entry.external_attr >> 16)
        plain = kind in (0, stat.S_IFREG, stat.S_IFDIR)
        is_file = plain and not entry.is_dir()
        is_folder = plain and entry.is_dir()
        yield _Member(entry.filename, entry.file_size, is_file, is_folder, partial(archive.open, entry))


def _write(members: Iterable[_Member], folder: Path, limit: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    total = 0
    for member in members:
        total += member.size
        if total > limit:
            raise ValueError(f"it would unpack to more than {limit} bytes")
        _write_member(member, _target(member, folder.resolve()))


def _target(member: _Member, folder: Path) -> Path:
    """Where the member goes; Windows' rules are the stricter ones, so every system refuses the same names."""
    if not (member.is_file or member.is_folder):
        raise ValueError(f"its member {member.name!r} is neither a file nor a folder")
    name = PureWindowsPath(member.name)
    target = (folder / member.name).resolve()
    if name.anchor or ".." in name.parts or not target.is_relative_to(folder):
        raise ValueError(f"its member {member.name!r} would land outside the folder")
    return target


def _write_member(member: _Member, target: Path) -> None:
    if member.is_folder:
        target.mkdir(parents=True, exist_ok=True)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    source = member.open()
    assert source is not None
    with source, target.open("wb") as sink:
        shutil.copyfileobj(source, sink)
