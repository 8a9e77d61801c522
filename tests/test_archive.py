"""Unpacking archives: what a good one holds is written, what a bad one wants is refused in one sentence."""

import io
import stat
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from distrace.data.archive import unpack_deb, unpack_zip


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "", size: int = 0) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.type, entry.linkname, entry.size = kind, link, size
    return entry


def tar(*members: tuple[tarfile.TarInfo, bytes], packing: str = "xz") -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=f"w:{packing}") as archive:
        for entry, content in members:
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


def ar(path: Path, **parts: bytes) -> Path:
    content = b"!<arch>\n"
    for name, part in parts.items():
        header = f"{name.replace('_', '.'):<16}{0:<12}{0:<6}{0:<6}{100644:<8}{len(part):<10}`\n"
        content += header.encode() + part + b"\n" * (len(part) % 2)
    path.write_bytes(content)
    return path


def deb(path: Path, *members: tuple[tarfile.TarInfo, bytes], packing: str = "xz") -> Path:
    data = {f"data_tar_{packing}": tar(*members, packing=packing)}
    return ar(path, debianbinary=b"2.0\n", control_tar_xz=b"odd", **data)


def zipped(path: Path, **members: str) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def written(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("packing", ["xz", "gz"])
def test_a_package_gives_its_files(tmp_path, packing):
    members = (member("./usr", tarfile.DIRTYPE), b""), (member("./usr/a.txt"), b"hello"), (member("./b"), b"")
    unpack_deb(deb(tmp_path / "a.deb", *members, packing=packing), tmp_path / "out")
    assert written(tmp_path / "out") == {"usr/a.txt", "b"}
    assert (tmp_path / "out/usr/a.txt").read_bytes() == b"hello"


def test_of_a_package_folders_can_be_picked_and_what_is_elsewhere_does_not_matter(tmp_path):
    names = "./usr/a/x.txt", "usr/a/deep/y.txt", "usr/ab.txt", "usr/doc/copyright"
    members = [(member(name), b"") for name in names] + [(member("usr/door", tarfile.SYMTYPE, "/etc"), b"")]
    unpack_deb(deb(tmp_path / "a.deb", *members), tmp_path / "out", below=("usr/a", "usr/doc"))
    assert written(tmp_path / "out") == {"usr/a/x.txt", "usr/a/deep/y.txt", "usr/doc/copyright"}
    with pytest.raises(ValueError, match="would land outside"):
        unpack_deb(deb(tmp_path / "b.deb", (member("usr/a/../../../b"), b"")), tmp_path / "out", below=("usr/a",))


def test_a_zip_gives_its_files_and_empty_folders(tmp_path):
    unpack_zip(zipped(tmp_path / "a.zip", **{"x/a.txt": "hello", "y/": "", "b": ""}), tmp_path / "out")
    assert written(tmp_path / "out") == {"x/a.txt", "b"}
    assert (tmp_path / "out/x/a.txt").read_text() == "hello"
    assert (tmp_path / "out/y").is_dir()


def test_nothing_written_is_executable(tmp_path):
    script = member("run.sh")
    script.mode = 0o6777
    unpack_deb(deb(tmp_path / "a.deb", (script, b"#!/bin/sh\n")), tmp_path / "out")
    assert not (tmp_path / "out/run.sh").stat().st_mode & (0o111 | stat.S_ISUID | stat.S_ISGID)


OUTSIDE = ["../evil", "x/../../evil", "/evil", "..\\evil", "C:\\evil", "C:evil"]


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_package_cannot_write_outside_the_folder(tmp_path, name):
    path = deb(tmp_path / "a.deb", (member(name), b"x"))
    with pytest.raises(ValueError, match=r"a\.deb .*would land outside"):
        unpack_deb(path, tmp_path / "out")
    assert written(tmp_path) == {"a.deb"}


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_zip_cannot_write_outside_the_folder(tmp_path, name):
    with pytest.raises(ValueError, match=r"a\.zip .*would land outside"):
        unpack_zip(zipped(tmp_path / "a.zip", **{name: "x"}), tmp_path / "out")
    assert written(tmp_path) == {"a.zip"}


def test_a_link_that_was_there_before_leads_nobody_outside(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out/door").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="would land outside"):
        unpack_zip(zipped(tmp_path / "a.zip", **{"door/evil": "x"}), tmp_path / "out")
    assert written(tmp_path / "elsewhere") == set()


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE])
def test_a_package_with_links_or_devices_is_refused(tmp_path, kind):
    path = deb(tmp_path / "a.deb", (member("b"), b"x"), (member("a", kind, "b"), b""))
    with pytest.raises(ValueError, match="'a' is neither a file nor a folder"):
        unpack_deb(path, tmp_path / "out")
    assert not (tmp_path / "out/a").exists()


@pytest.mark.parametrize("name", ["a", "a/"])
def test_a_zip_with_links_is_refused(tmp_path, name):
    entry = zipfile.ZipInfo(name)
    entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(entry, "/etc/passwd")
    with pytest.raises(ValueError, match="is neither a file nor a folder"):
        unpack_zip(tmp_path / "a.zip", tmp_path / "out")
    assert not (tmp_path / "out/a").exists()


def test_an_archive_larger_than_the_limit_is_refused(tmp_path):
    zeros = "0" * 100_000
    bomb = zipped(tmp_path / "a.zip", a=zeros, b=zeros)
    unpack_zip(bomb, tmp_path / "fits", limit=200_000)
    with pytest.raises(ValueError, match="more than 199999 bytes"):
        unpack_zip(bomb, tmp_path / "out", limit=199_999)
    package = deb(tmp_path / "a.deb", (member("a"), zeros.encode()))
    with pytest.raises(ValueError, match="more than 99999 bytes"):
        unpack_deb(package, tmp_path / "out", limit=99_999)


@pytest.mark.parametrize("unpack", [unpack_deb, unpack_zip])
@pytest.mark.parametrize("content", [b"", b"just a text\n", b"!<arch>\n", b"!<arch>\nshort", b"PK\x03\x04"])
def test_other_files_end_in_a_sentence_with_their_name(tmp_path, unpack, content):
    path = tmp_path / "mine.bin"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"mine\.bin cannot be unpacked .* download .* again") as error:
        unpack(path, tmp_path / "out")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("unpack", [unpack_deb, unpack_zip])
def test_a_missing_file_and_a_folder_are_named(tmp_path, unpack):
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(ValueError, match=rf"{path.name} (does not exist|.*no such file)"):
            unpack(path, tmp_path / "out")


def test_a_package_cut_off_anywhere_is_refused(tmp_path):
    whole = deb(tmp_path / "a.deb", (member("a"), bytes(range(256)) * 40)).read_bytes()
    cut = tmp_path / "cut.deb"
    for length in range(0, len(whole.rstrip(b"\n")), 7):
        cut.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"cut\.deb"):
            unpack_deb(cut, tmp_path / "out")


def test_a_zip_cut_off_anywhere_is_refused(tmp_path):
    whole = zipped(tmp_path / "a.zip", a="hello" * 50, b="x").read_bytes()
    cut = tmp_path / "cut.zip"
    for length in range(0, len(whole), 7):
        cut.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"cut\.zip"):
            unpack_zip(cut, tmp_path / "out")


@pytest.mark.parametrize("packing", ["xz", "gz"])
def test_a_package_whose_checksum_differs_is_refused(tmp_path, packing):
    content = bytearray(tar((member("a"), b"hello" * 500), packing=packing))
    content[-6 if packing == "gz" else -30] ^= 1
    path = ar(tmp_path / "a.deb", **{f"data_tar_{packing}": bytes(content)})
    with pytest.raises(ValueError, match=r"a\.deb"):
        unpack_deb(path, tmp_path / "out")


def test_a_zip_whose_checksum_differs_is_refused(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", "hello")
    path.write_bytes(path.read_bytes().replace(b"hello", b"hallo"))
    with pytest.raises(ValueError, match=r"a\.zip .*CRC"):
        unpack_zip(path, tmp_path / "out")


@pytest.mark.parametrize("unpack", [unpack_deb, unpack_zip])
def test_an_empty_file_is_called_empty(tmp_path, unpack):
    (tmp_path / "mine.bin").touch()
    with pytest.raises(ValueError, match=r"mine\.bin .*it is empty"):
        unpack(tmp_path / "mine.bin", tmp_path / "out")


@pytest.mark.parametrize(
    ("length", "complaint"), [("-5", "cut off"), ("9999999999", "cut off"), ("abc", "invalid literal")]
)
def test_a_member_length_that_cannot_be_is_refused(tmp_path, length, complaint):
    path = ar(tmp_path / "a.deb", data_tar_xz=b"")
    content = path.read_bytes()
    path.write_bytes(content[:56] + f"{length:<10}".encode() + content[66:])
    with pytest.raises(ValueError, match=rf"a\.deb .*{complaint}"):
        unpack_deb(path, tmp_path / "out")


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="Python 3.14 reads zstd itself")
def test_a_package_packed_with_zstd_says_what_it_needs(tmp_path):
    path = ar(tmp_path / "a.deb", data_tar_zst=b"\x28\xb5\x2f\xfd")
    with pytest.raises(ValueError, match=r"data\.tar\.zst needs Python 3\.14"):
        unpack_deb(path, tmp_path / "out")
