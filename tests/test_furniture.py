"""The catalogue of furniture, on a tiny package of the same make."""

import csv
import errno
import io
import os
import shutil
import tarfile
import zipfile
from pathlib import Path

import pytest

from distrace.data.debian import MeshEntry, catalogue_package, catalogue_summary, fetch, write_catalogue
from distrace.data.furniture import PACKAGE, catalogue

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
ZERO = {
    "PluginFurnitureCatalog.properties": (
        "# 3D models created by various authors, available elsewhere\n"
        "name=Zero\n\n"
        "name#1=Captain's bed\ntags#1=\nmodel#1=/zero/bed/bed.obj\ncreator#1=Jane\n"
        "name#2=Bill 10\\u20ac\nmodel#2=/zero/bill/bill.obj\n"
        "name#3=Ford\ntags#3=Old, Car\nmodel#3=/zero/ford/ford.obj\n"
        "name#4=Zipped sofa\nmodel#4=/zero/sofa.zip\ncreator#4=Jane\n"
        "name#5=Missing stool\nmodel#5=/zero/missing.obj\n"
        "name#6=Fled chair\nmodel#6=/../Other/other/lamp.obj\n"
        "dropOnTopElevation#-1\n"
    ),
    "LICENSE.TXT": "public domain\n http://creativecommons.org/choose/zero/ \n",
    "zero/bed/bed.obj": TRIANGLE,
    "zero/bill/bill.obj": TRIANGLE,
    "zero/bill/BLENDSWAP_LICENSE.txt": 'Thank you for downloading "A bill" by Doug C\nReleased under\n',
    "zero/ford/ford.obj": TRIANGLE,
    "zero/sofa.zip": "PK",
}
OTHER = {
    "PluginFurnitureCatalog.properties": (
        "# 3D models created by Ann & Bob\nid=x\nname#1=Desk lamp\nmodel#1=/other/lamp.obj\n"
    ),
    "LICENSE.TXT": "see http://creativecommons.org/licenses/by/3.0/us/\n",
    "other/lamp.obj": TRIANGLE,
}
SHELVES = {"Zero": ZERO, "Other": OTHER}


def shelf(members: dict[str, str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def write_deb(path: Path, files: dict[str, bytes]) -> Path:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:xz") as archive:
        for name, content in files.items():
            entry = tarfile.TarInfo(f"./usr/share/{name}")
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    packed = buffer.getvalue()
    header = f"{'data.tar.xz':<16}{0:<12}{0:<6}{0:<6}{100644:<8}{len(packed):<10}`\n"
    path.write_bytes(b"!<arch>\n" + header.encode() + packed)
    return path


@pytest.fixture
def deb(tmp_path) -> Path:
    shelves = {f"sweethome3d/furniture/{name}.sh3f": shelf(members) for name, members in SHELVES.items()}
    copyright_ = {"doc/sweethome3d-furniture/copyright": b"as they say\n"}
    return write_deb(tmp_path / "sweethome3d-furniture_1_all.deb", shelves | copyright_)


def files(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_the_catalogue_lists_every_obj_with_creator_and_licence(deb, tmp_path):
    home = Path("sweethome3d-furniture")
    expected = [
        MeshEntry("other", "Desk lamp", "Ann & Bob", "CC-BY-3.0-US", str(home), home / "Other/other/lamp.obj"),
        MeshEntry("bed", "Captain's bed", "Jane", "CC0-1.0", str(home), home / "Zero/zero/bed/bed.obj"),
        MeshEntry("other", "Bill 10€", "Doug C", "CC0-1.0", str(home), home / "Zero/zero/bill/bill.obj"),
        MeshEntry("car", "Ford", "various authors", "CC0-1.0", str(home), home / "Zero/zero/ford/ford.obj"),
    ]
    meshes = catalogue(deb, tmp_path / "out")
    assert meshes == expected
    assert all((tmp_path / "out" / mesh.path).read_text() == TRIANGLE for mesh in meshes)
    assert (tmp_path / "out" / home / "copyright").read_text() == "as they say\n"


def test_the_summary_counts_categories_and_licences(deb, tmp_path):
    text = catalogue_summary(catalogue(deb, tmp_path))
    assert text.startswith("4 meshes (2 other, ")
    assert "3 CC0-1.0" in text


def test_a_link_in_place_of_the_table_or_of_what_is_unpacked_is_replaced_not_followed(deb, tmp_path):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    out.mkdir()
    elsewhere.mkdir()
    (elsewhere / "passwd").write_text("root")
    (out / "shapes.csv").symlink_to(elsewhere / "passwd")
    (out / f".{PACKAGE}.partial").symlink_to(elsewhere)
    (out / PACKAGE).symlink_to(tmp_path / "nowhere")
    catalogue_package(PACKAGE, catalogue, out, deb)
    assert {path.name: path.read_text() for path in elsewhere.iterdir()} == {"passwd": "root"}
    assert not any(path.is_symlink() for path in out.iterdir())
    assert (out / "shapes.csv").read_text().startswith("category,name")


def test_a_table_whose_writing_fails_stays_as_it_was(deb, tmp_path, monkeypatch):
    meshes = catalogue_package(PACKAGE, catalogue, tmp_path, deb)
    before = (tmp_path / "shapes.csv").read_text()
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left on device"):
        write_catalogue(meshes[:1], tmp_path / "shapes.csv")
    assert (tmp_path / "shapes.csv").read_text() == before


def full_disk(*given: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_is_called_full_and_no_download_is_blamed(deb, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "copyfileobj", full_disk)
    with pytest.raises(OSError, match=r"^\[Errno \d+\] No space left on device$"):
        catalogue_package(PACKAGE, catalogue, tmp_path / "out", deb)


def test_the_table_is_written(deb, tmp_path):
    meshes = catalogue_package(PACKAGE, catalogue, tmp_path / "new/out", deb)
    with (tmp_path / "new/out/shapes.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["category", "name", "creator", "licence", "debian_package", "path"]
    assert [row["name"] for row in rows] == [mesh.name for mesh in meshes]
    assert rows[2] == {
        "category": "other",
        "name": "Bill 10€",
        "creator": "Doug C",
        "licence": "CC0-1.0",
        "debian_package": "sweethome3d-furniture",
        "path": "sweethome3d-furniture/Zero/zero/bill/bill.obj",
    }


def test_names_with_commas_and_quotes_survive_the_table(tmp_path):
    mesh = MeshEntry("other", 'Plate, "glass"\nand cutlery', "Ann", "CC0-1.0", "p", Path("a.obj"))
    write_catalogue([mesh], tmp_path / "shapes.csv")
    with (tmp_path / "shapes.csv").open(newline="", encoding="utf-8") as file:
        assert next(csv.DictReader(file))["name"] == mesh.name


def test_a_second_call_unpacks_nothing(deb, tmp_path):
    first = catalogue(deb, tmp_path / "out")
    before = files(tmp_path / "out")
    assert catalogue(deb, tmp_path / "out") == first
    assert files(tmp_path / "out") == before


def test_a_half_finished_unpacking_is_done_again(deb, tmp_path):
    partial = tmp_path / "out/.sweethome3d-furniture.partial"
    (partial / "Zero").mkdir(parents=True)
    (partial / "Zero/junk").write_text("half")
    assert len(catalogue(deb, tmp_path / "out")) == 4
    assert not partial.exists()
    assert not list((tmp_path / "out").rglob("junk"))


def test_a_failed_unpacking_leaves_no_catalogue_behind(deb, tmp_path):
    whole = deb.read_bytes()
    deb.write_bytes(whole[:-20])
    with pytest.raises(ValueError, match=deb.name):
        catalogue(deb, tmp_path / "out")
    assert not (tmp_path / "out/sweethome3d-furniture").exists()
    deb.write_bytes(whole)
    assert len(catalogue(deb, tmp_path / "out")) == 4


def test_another_version_of_the_package_replaces_the_old_one(deb, tmp_path):
    catalogue(deb, tmp_path / "out")
    newer = tmp_path / "sweethome3d-furniture_2_all.deb"
    write_deb(newer, {"sweethome3d/furniture/Other.sh3f": shelf(OTHER)})
    assert [mesh.name for mesh in catalogue(newer, tmp_path / "out")] == ["Desk lamp"]
    assert not (tmp_path / "out/sweethome3d-furniture/Zero").exists()


def test_a_folder_of_somebody_else_is_never_removed(deb, tmp_path):
    theirs = tmp_path / "out/sweethome3d-furniture/theirs.txt"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("keep")
    with pytest.raises(ValueError, match="not an unpacked catalogue; move it"):
        catalogue(deb, tmp_path / "out")
    assert theirs.read_text() == "keep"


def test_a_folder_given_by_a_relative_path_works(deb, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert len(catalogue(Path("..") / deb.name, Path("../out"))) == 4


def test_another_package_is_refused_with_advice(tmp_path):
    other = write_deb(tmp_path / "other.deb", {"doc/other/copyright": b""})
    with pytest.raises(ValueError, match=r"other\.deb holds no furniture catalogue.*--from FILE\.deb"):
        catalogue(other, tmp_path / "out")
    with pytest.raises(ValueError, match=r"no file .*missing\.deb.*--from FILE\.deb"):
        catalogue(tmp_path / "missing.deb", tmp_path / "out")


def test_a_broken_shelf_inside_the_package_is_named(tmp_path):
    path = write_deb(tmp_path / "a.deb", {"sweethome3d/furniture/Bad.sh3f": b"no zip"})
    with pytest.raises(ValueError, match=r"Bad\.sh3f cannot be unpacked"):
        catalogue(path, tmp_path / "out")


def test_an_out_that_is_a_file_is_refused(deb):
    with pytest.raises(ValueError, match="choose another --out"):
        catalogue_package(PACKAGE, catalogue, deb, deb)


@pytest.mark.parametrize(
    ("name", "tags", "category"),
    [
        ("Winchester armchair", "", "chair"),
        ("Bedside table", "Bed", "table"),
        ("Sofa 2 seats", "", "sofa"),
        ("Futon couch", "", "sofa"),
        ("Bar stool", "", "stool"),
        ("Desk", "", "table"),
        ("City bus", "", "car"),
        ("Seat Leon", "Car", "car"),
        ("Car model", "Toy", "other"),
        ("Table tennis bat", "", "other"),
        ("Wheelchair", "", "other"),
        ("Carpet", "Cartoon", "other"),
    ],
)
def test_the_category_follows_from_the_name(tmp_path, name, tags, category):
    members = OTHER | {"PluginFurnitureCatalog.properties": f"name#1={name}\ntags#1={tags}\nmodel#1=/other/lamp.obj\n"}
    path = write_deb(tmp_path / "a.deb", {"sweethome3d/furniture/A.sh3f": shelf(members)})
    assert catalogue(path, tmp_path / "out")[0].category == category


@pytest.mark.parametrize(
    ("text", "licence"),
    [
        ("http://creativecommons.org/licenses/by/3.0/", "CC-BY-3.0"),
        ("http://creativecommons.org/licenses/by-sa/4.0/legalcode", "CC-BY-SA-4.0"),
        ("http://creativecommons.org/publicdomain/zero/1.0/", "CC0-1.0"),
        ("ask the author", "as agreed"),
    ],
)
def test_the_licence_is_read_from_the_catalogue(tmp_path, text, licence):
    header = "license=as agreed\nname#1=x\nmodel#1=/other/lamp.obj\n"
    members = OTHER | {"LICENSE.TXT": text, "PluginFurnitureCatalog.properties": header}
    path = write_deb(tmp_path / "a.deb", {"sweethome3d/furniture/A.sh3f": shelf(members)})
    assert catalogue(path, tmp_path / "out")[0].licence == licence


def fake_apt_get(folder: Path, script: str) -> str:
    folder.mkdir()
    (folder / "apt-get").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "apt-get").chmod(0o755)
    return f"{folder}{os.pathsep}{os.environ['PATH']}"


def test_fetch_asks_apt_get_once(tmp_path, monkeypatch):
    script = f'echo "$@" >> {tmp_path}/calls; echo deb > sweethome3d-furniture_1_all.deb'
    monkeypatch.setenv("PATH", fake_apt_get(tmp_path / "bin", script))
    (tmp_path / "out").mkdir()
    for _ in range(2):
        assert fetch(PACKAGE, tmp_path / "out") == tmp_path / "out/sweethome3d-furniture_1_all.deb"
    assert (tmp_path / "calls").read_text() == "download sweethome3d-furniture\n"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["sweethome3d-furniture_1_all.deb"]


@pytest.mark.parametrize("status", [0, 100])
def test_a_failing_apt_get_ends_in_advice_and_leaves_nothing(tmp_path, monkeypatch, status):
    half = "echo half > sweethome3d-furniture_1_all.deb; " if status else ""
    script = f"{half}echo W: first >&2; echo E: Unable to locate >&2; exit {status}"
    monkeypatch.setenv("PATH", fake_apt_get(tmp_path / "bin", script))
    (tmp_path / "out").mkdir()
    with pytest.raises(ValueError, match=r"--from FILE\.deb \(E: Unable to locate\)$"):
        fetch(PACKAGE, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_system_without_apt_get_is_told_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ValueError, match=r"download the \.deb by hand .*--from FILE\.deb"):
        fetch(PACKAGE, tmp_path)
