"""The catalogue of aircraft, on a tiny package of the same make; and the files that they come in."""

from pathlib import Path

import numpy as np
import pytest
from test_furniture import write_deb

from distrace.data.ac3d import load_ac3d, load_surfaces
from distrace.data.debian import catalogue_package
from distrace.data.mesh_files import load_soup
from distrace.data.planes import PACKAGE, PARKED_PACKAGE, catalogue, parked
from distrace.data.solid import load_solid

HEAD = 'AC3Db\nMATERIAL "" rgb 1 1 1  amb 1 1 1  emis 0 0 0  spec 0 0 0  shi 0  trans 0\n'
TRIANGLE = "SURF 0x10\nmat 0\nrefs 3\n0 0 0\n1 0 0\n2 0 0\n"
LINE = "SURF 0x02\nmat 0\nrefs 3\n0 0 0\n1 0 0\n2 0 0\n"
CORNERS = "numvert 3\n0 0 0\n1 0 0\n0 1 0\n"


def poly(surfaces: list[str], before: str = "", vertices: str = CORNERS, kids: str = "kids 0\n") -> str:
    return f'OBJECT poly\nname "a"\n{before}{vertices}numsurf {len(surfaces)}\n{"".join(surfaces)}{kids}'


def written(folder: Path, content: str) -> Path:
    path = folder / "plane.ac"
    path.write_text(content)
    return path


def test_objects_are_placed_in_what_holds_them(tmp_path: Path) -> None:
    """A quarter turn about z takes x to y: rows of `rot` are the images of the axes."""
    inner = poly([TRIANGLE], "loc 1 0 0\n")
    turn = "rot 0 1 0 -1 0 0 0 0 1\nloc 0 0 5\n"
    content = f"{HEAD}OBJECT world\nkids 2\nOBJECT group\n{turn}kids 1\n{inner}{poly([TRIANGLE])}"
    placed, plain = load_ac3d(written(tmp_path, content))
    np.testing.assert_allclose(placed, [[0, 1, 5], [0, 2, 5], [-1, 1, 5]])
    np.testing.assert_allclose(plain, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_polygons_become_fans_and_lines_nothing(tmp_path: Path) -> None:
    square = "SURF 0X30\nrefs 4\n0 0 0\n1 0 0\n2 0 0\n3 0 0\n"
    vertices = "numvert 4\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
    path = written(tmp_path, HEAD + poly([LINE, square, "SURF 0x10\nrefs 2\n0 0 0\n1 0 0\n"], "", vertices))
    triangles = load_ac3d(path)
    assert triangles.shape == (2, 3, 3)
    soup = load_soup(path)
    assert soup.area == pytest.approx(1.0)


def test_what_an_object_says_in_words_of_its_own_is_passed_by(tmp_path: Path) -> None:
    content = HEAD + "OBJECT world\nkids 3\n" + poly([TRIANGLE], 'data 7\nOBJECT \ntexture "kids 2"\ncrease 30\n\n')
    assert len(load_ac3d(written(tmp_path, content))) == 1, "and fewer kids than announced are no error"


def test_surfaces_know_their_image_where_they_lie_on_it_and_the_colour_of_their_material(tmp_path: Path) -> None:
    red = 'MATERIAL "b" rgb 0.9 0.1 0  amb 0 0 0  emis 0 0 0  spec 0 0 0  shi 0  trans 0\n'
    marked = "SURF 0x10\nmat 1\nrefs 3\n0 0 0\n1 0.5 0\n2 0 1\n"
    image = 'texture "C:\\\\art\\\\my skin.png"\ntexrep 2 1\ntexoff 0 0.25\n'
    content = f"{HEAD}{red}OBJECT world\nkids 2\n{poly([marked], image)}{poly([TRIANGLE])}"
    colours, (with_image, plain) = load_surfaces(written(tmp_path, content))
    np.testing.assert_allclose(colours, [[1, 1, 1], [0.9, 0.1, 0]])
    assert (with_image.image, plain.image) == ("my skin.png", "")
    assert (with_image.material.tolist(), plain.material.tolist()) == ([1], [0])
    np.testing.assert_allclose(with_image.uv, [[[0, 0.25], [1, 0.25], [0, 1.25]]])


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("", "does not begin with AC3D"),
        ("OFF\n3 1 0\n", "does not begin with AC3D"),
        (HEAD + "OBJECT world\nkids 0\n", "holds no polygon"),
        (HEAD + poly([LINE]), "holds no polygon"),
        (HEAD + "OBJECT poly\nnumvert 5\n0 0 0\n", "ends early"),
        (HEAD + poly([TRIANGLE.replace("2 0 0", "7 0 0")]), "ends early, or has surfaces with corners"),
        (HEAD + poly([TRIANGLE.replace("2 0 0", "-1 0 0")]), "negative"),
        (HEAD + poly([TRIANGLE], vertices="numvert 3\n0 0 0\nx 0 0\n0 1 0\n"), "could not convert string to float"),
    ],
)
def test_a_broken_file_ends_in_one_sentence(tmp_path: Path, content: str, why: str) -> None:
    with pytest.raises(ValueError, match=rf"plane.ac cannot be read as a triangle mesh.*{why}"):
        load_solid(written(tmp_path, content))


@pytest.fixture
def deb(tmp_path: Path) -> Path:
    small, large = HEAD + poly([TRIANGLE]), HEAD + poly([TRIANGLE, TRIANGLE])
    root = "games/flightgear/AI/Aircraft"
    files = {
        f"{root}/733/Models/733.ac": small,
        f"{root}/733/Models/73C.ac": large,
        f"{root}/733/Models/lights/flash.ac": large * 2,
        f"{root}/733/733-main.xml": "<xml/>",
        f"{root}/Jet/jet.ac": small,
        f"{root}/balloon/Models/balloon.ac": small,
        "doc/flightgear-data-ai/copyright": "as they say\n",
    }
    return write_deb(tmp_path / "flightgear-data-ai_1_all.deb", {name: text.encode() for name, text in files.items()})


def test_each_aircraft_has_one_mesh_the_one_with_most_in_it(deb: Path, tmp_path: Path) -> None:
    meshes = catalogue(deb, tmp_path / "out")
    found = [(mesh.category, mesh.name, mesh.path.name) for mesh in meshes]
    assert found == [("plane", "733", "73C.ac"), ("plane", "Jet", "jet.ac"), ("other", "balloon", "balloon.ac")]
    assert {mesh.licence for mesh in meshes} == {"GPL-2.0-or-later"}
    assert all(len(load_ac3d(tmp_path / "out" / mesh.path)) for mesh in meshes)


def test_meshes_and_the_copyright_are_kept_and_nothing_else(deb: Path, tmp_path: Path) -> None:
    catalogue_package(PACKAGE, catalogue, tmp_path / "out", deb)
    home = tmp_path / "out/flightgear-data-ai"
    assert (home / "copyright").read_text() == "as they say\n"
    assert not list(home.rglob("*.xml"))
    table = (tmp_path / "out/shapes.csv").read_text().splitlines()
    assert table[0] == "category,name,creator,licence,debian_package,path"
    assert table[1].endswith("flightgear-data-ai/733/Models/73C.ac")


def test_a_mesh_has_the_images_that_it_names_beside_it_of_liveries_the_default_one(tmp_path: Path) -> None:
    root = "games/flightgear/AI/Aircraft/Jet"
    mesh = HEAD + poly([TRIANGLE], 'texture "skin.png"\n') + poly([TRIANGLE], 'texture "crew/face.rgb"\n')
    files = {
        f"{root}/Models/jet.ac": mesh.encode(),
        f"{root}/Models/crew/face.rgb": b"face",
        f"{root}/Textures/AirA/skin.png": b"A",
        f"{root}/Textures/Default/skin.png": b"default",
        f"{root}/Textures/Default/unused.png": b"unused",
    }
    catalogue(write_deb(tmp_path / "flightgear-data-ai_1_all.deb", files), tmp_path / "out")
    kept = {path.name: path.read_bytes() for path in (tmp_path / "out/flightgear-data-ai/Jet/Models").glob("*.*")}
    assert kept == {"jet.ac": mesh.encode(), "skin.png": b"default", "face.rgb": b"face"}


def test_another_package_is_refused(tmp_path: Path) -> None:
    other = write_deb(tmp_path / "other.deb", {"doc/other/copyright": b""})
    with pytest.raises(ValueError, match=r"other.deb holds no aircraft .*--from FILE\.deb"):
        catalogue(other, tmp_path / "out")


def test_each_parked_mesh_is_listed_with_its_images_and_nothing_else_of_the_package(tmp_path: Path) -> None:
    root = "games/flightgear/Scenery/Models"
    mesh = HEAD + poly([TRIANGLE], 'texture "skin.png"\n')
    files = {
        f"{root}/Aircraft/jet.ac": mesh,
        f"{root}/Aircraft/skin.png": "skin",
        f"{root}/Aircraft/unused.png": "unused",
        f"{root}/Aircraft/trailer.ac": HEAD + poly([TRIANGLE]),
        f"{root}/Airport/tower.ac": HEAD + poly([TRIANGLE]),
    }
    deb = write_deb(tmp_path / "flightgear-data-base_1_all.deb", {name: text.encode() for name, text in files.items()})
    meshes = catalogue_package(PARKED_PACKAGE, parked, tmp_path / "out", deb)
    assert [(mesh.name, mesh.licence) for mesh in meshes] == [(name, "GPL-2.0-or-later") for name in ("jet", "trailer")]
    assert all(len(load_ac3d(tmp_path / "out" / mesh.path)) for mesh in meshes)
    kept = {path.name for path in (tmp_path / "out/flightgear-data-base").iterdir()}
    assert kept == {"jet.ac", "skin.png", "trailer.ac", "unpacked-from.txt"}


def test_a_package_without_parked_aircraft_is_refused(deb: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no aircraft .*flightgear-data-base and pass --from FILE\.deb"):
        parked(deb, tmp_path / "out")
