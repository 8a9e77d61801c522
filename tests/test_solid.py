"""The solid of a triangle soup, on boxes whose answers are known in closed form."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from distrace.data.solid import RADIUS, SMALLEST, Solid, load_solid, turned
from distrace.fields import primitives

SHIFT = np.array([0.5, 0.3, 0.2])  # of the second of two unit cubes
MIDDLE = SHIFT / 2
SCALE = RADIUS / np.linalg.norm((1 + SHIFT) / 2)
CUBE = RADIUS / math.sqrt(3) * 2  # the edge of a single cube, once normalised


def cubes() -> trimesh.Trimesh:
    second = trimesh.creation.box((1, 1, 1))
    second.apply_translation(SHIFT)
    return trimesh.util.concatenate([trimesh.creation.box((1, 1, 1)), second])


def union(points: np.ndarray) -> np.ndarray:
    """Distance to the two cubes in the solid's frame: exact outside, and where it is zero."""
    half = torch.full((3,), 0.5 * SCALE, dtype=torch.float64)
    centres = (-MIDDLE * SCALE, (SHIFT - MIDDLE) * SCALE)
    return np.minimum(*(primitives.box(half)(torch.from_numpy(points - centre)).numpy() for centre in centres))


def stored(folder: Path, mesh: trimesh.Trimesh) -> Path:
    path = folder / "mesh.ply"
    mesh.export(path)
    return path


def without_top(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.update_faces(mesh.face_normals[:, 1] < 0.5)
    return mesh


def scattered(count: int = 400) -> np.ndarray:
    return np.random.default_rng(5).uniform(-1, 1, (count, 3))


@pytest.fixture(scope="module")
def overlapping(tmp_path_factory: pytest.TempPathFactory) -> Solid:
    return load_solid(stored(tmp_path_factory.mktemp("solid"), cubes()))


def test_the_outer_surface_of_overlapping_cubes_has_the_area_of_their_union(overlapping: Solid) -> None:
    a, b, c = 1 - SHIFT
    area = 12 - 2 * (a * b + b * c + c * a)  # the faces of the common block are buried
    assert overlapping.surface.area == pytest.approx(area * SCALE**2, rel=0.01)
    assert overlapping.surface.volume == pytest.approx((2 - a * b * c) * SCALE**3, rel=0.01)


def test_no_face_that_is_kept_lies_inside(overlapping: Solid) -> None:
    assert np.abs(union(overlapping.surface.triangles_center)).max() < SMALLEST
    soup, _ = trimesh.sample.sample_surface(overlapping.soup, 2000, seed=0)
    assert (union(soup) < -0.1).any(), "of the soup, some does"


def test_at_a_buried_face_the_distance_is_that_of_the_outer_surface_and_negative(overlapping: Solid) -> None:
    buried = (np.array([[0.5, 0.15, 0.1]]) - MIDDLE) * SCALE  # on the first cube's face x = 0.5, within the second
    (distance,) = overlapping.distance(buried)
    assert distance == pytest.approx(-0.35 * SCALE, abs=2 * SMALLEST), "to the edge at y = -0.2, which is left ragged"


def test_outside_the_distance_is_that_of_the_union(overlapping: Solid) -> None:
    points = scattered()
    expected = union(points)
    outside, clear = expected > 0.01, np.abs(expected) > 1e-3
    np.testing.assert_allclose(overlapping.distance(points)[outside], expected[outside], atol=SMALLEST)
    np.testing.assert_array_equal(overlapping.contains(points)[clear], expected[clear] < 0)


def test_a_cube_drawn_inside_out_is_a_cube(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.invert()
    solid = load_solid(stored(tmp_path, mesh))
    assert solid.surface.volume == pytest.approx(CUBE**3, rel=1e-5), "positive: its normals point out"
    assert solid.distance(np.zeros((1, 3))) == pytest.approx([-CUBE / 2], abs=1e-6)


LEG = (0.5, 2, 0.5)
THROUGH = trimesh.transformations.translation_matrix((0.5, -0.8, 0.5))


@pytest.mark.parametrize("suffix", ["ply", "stl"])
@pytest.mark.parametrize("inverted", [(False, True), (True, False), (True, True)], ids=["leg", "seat", "both"])
@pytest.mark.parametrize("capped", [True, False])
def test_what_parts_share_is_inside_also_if_one_is_drawn_inside_out(
    tmp_path: Path, suffix: str, inverted: tuple[bool, bool], capped: bool
) -> None:
    """A leg through a seat: the winding numbers of both must not cancel."""
    parts = [trimesh.creation.box((2, 0.4, 2)), trimesh.creation.box(LEG, THROUGH)]
    right = load_solid(stored(tmp_path, trimesh.util.concatenate(parts)))
    parts[1] = parts[1] if capped else without_top(parts[1])
    for part, invert in zip(parts, inverted):
        if invert:
            part.invert()
    path = tmp_path / f"parts.{suffix}"
    trimesh.util.concatenate(parts).export(path)
    solid = load_solid(path)
    points = scattered(2000) * 0.6
    clear = np.abs(right.distance(points)) > 0.02
    np.testing.assert_array_equal(solid.contains(points)[clear], right.contains(points)[clear])


@pytest.mark.parametrize("inverted", [True, False])
def test_a_cavity_stays_empty(tmp_path: Path, inverted: bool) -> None:
    inner = trimesh.creation.icosphere(3, 0.5)
    inner.invert()
    hollow = trimesh.util.concatenate([trimesh.creation.icosphere(3, 1.0), inner])
    if inverted:
        hollow.invert()
    solid = load_solid(stored(tmp_path, hollow))
    radii = np.array([0.0, 0.4, 0.6, 0.9])[:, None] * RADIUS
    assert solid.contains(radii * [[0.0, 0.6, 0.8]]).tolist() == [False, False, True, True]


BYTES = b"caf\xe9 \xff\x80"


@pytest.mark.parametrize(
    ("name", "how", "before"),
    [
        ("a.obj", {}, b"v "),
        ("a.off", {}, b"8 12"),
        ("a.stl", {"file_type": "stl_ascii"}, b"solid"),
        ("a.ply", {"encoding": "ascii"}, b"element vertex"),
        ("a.ply", {"encoding": "binary"}, b"element vertex"),
    ],
    ids=["OBJ", "OFF", "ASCII STL", "ASCII PLY", "binary PLY"],
)
def test_names_and_comments_may_hold_any_bytes(tmp_path: Path, name: str, how: dict, before: bytes) -> None:
    content = trimesh.creation.box((1, 1, 1)).export(**({"file_type": name[-3:]} | how))
    content = content.encode() if isinstance(content, str) else content
    said = {"a.ply": b"comment " + BYTES + b"\n" + before, "a.stl": b"solid " + BYTES}.get(name)
    said = said or b"# " + BYTES + b"\n" + before
    assert before in content
    (tmp_path / name).write_bytes(content.replace(before, said, 1))
    assert load_solid(tmp_path / name).surface.volume == pytest.approx(CUBE**3, rel=1e-5)


def test_a_binary_stl_may_begin_like_text(tmp_path: Path) -> None:
    content = trimesh.creation.box((1, 1, 1)).export(file_type="stl")
    (tmp_path / "a.stl").write_bytes((b"solid " + BYTES).ljust(80, b"\xfe") + content[80:])
    assert load_solid(tmp_path / "a.stl").surface.volume == pytest.approx(CUBE**3, rel=1e-5)


def test_a_cube_that_lacks_a_face_keeps_its_inside(tmp_path: Path) -> None:
    solid = load_solid(stored(tmp_path, without_top(trimesh.creation.box((1, 1, 1)))))
    assert solid.surface.area == pytest.approx(5 * CUBE**2, rel=0.01)
    points = scattered()
    expected = primitives.box(torch.full((3,), CUBE / 2, dtype=torch.float64))(torch.from_numpy(points)).numpy()
    clear = np.abs(expected) > 0.03
    np.testing.assert_array_equal(solid.contains(points)[clear], expected[clear] < 0)
    assert solid.distance(np.zeros((1, 3))) == pytest.approx([-CUBE / 2], abs=1e-6)
    below_the_gap = np.array([[0.0, CUBE / 2 - 0.1, 0.0]])
    assert solid.distance(below_the_gap) == pytest.approx([-CUBE / 2], abs=1e-6), "no face, no distance to it"


def test_a_solid_is_centred_and_its_farthest_vertex_lies_at_the_radius_of_deepsdf(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.apply_translation((40, -7, 3))
    solid = load_solid(stored(tmp_path, mesh))
    for part in (solid.soup, solid.surface):
        np.testing.assert_allclose(part.bounds.sum(0), 0, atol=1e-5)
        assert np.linalg.norm(part.vertices, axis=1).max() == pytest.approx(1 / 1.03, abs=1e-5)


def test_a_turn_about_y_carries_distances_along(overlapping: Solid) -> None:
    points = scattered()
    turn = math.radians(30)
    x, y, z = points.T
    there = np.stack([x * math.cos(turn) + z * math.sin(turn), y, z * math.cos(turn) - x * math.sin(turn)], axis=1)
    before, after = overlapping.distance(points), turned(overlapping, 30.0).distance(there)
    clear = np.abs(before) > 1e-3
    np.testing.assert_allclose(after[clear], before[clear], atol=1e-6)


def assert_same_solid(solid: Solid, other: Solid) -> None:
    points = scattered()
    distances, others = solid.distance(points), other.distance(points)
    clear = np.abs(others) > SMALLEST
    np.testing.assert_allclose(distances[clear], others[clear], atol=SMALLEST)
    assert solid.surface.volume == pytest.approx(other.surface.volume, rel=0.01)
    assert solid.surface.volume > 0


def test_a_quarter_turn_is_the_solid_of_the_turned_mesh(overlapping: Solid, tmp_path: Path) -> None:
    mesh = cubes()
    x, y, z = mesh.vertices.T
    mesh.vertices = np.stack([z, y, -x], axis=1)
    assert_same_solid(turned(overlapping, 90.0), load_solid(stored(tmp_path, mesh)))


def test_a_sheet_bounds_no_solid(tmp_path: Path) -> None:
    corners = [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]
    path = stored(tmp_path, trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]))
    with pytest.raises(ValueError, match=r"mesh\.ply bounds no solid: only 0% of its faces have an inside"):
        load_solid(path)


@pytest.mark.parametrize("name", ["words.obj", "words.ply", "words.stl", "words.glb", "words.txt"])
@pytest.mark.parametrize("content", [b"no mesh at all\n", b"", None], ids=["text", "empty", "missing"])
def test_what_is_no_mesh_ends_in_one_sentence_that_names_it(tmp_path: Path, name: str, content: bytes | None) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"cannot be read as a triangle mesh|does not exist") as caught:
        load_solid(path)
    assert ("does not exist" in str(caught.value)) == (content is None)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_vertices_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "nan.off"
    path.write_text("OFF\n3 1 0\n0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(ValueError, match="not finite"):
        load_solid(path)


def test_a_mesh_without_area_ends_in_one_sentence(tmp_path: Path) -> None:
    for name, corners in (("line", [[0, 0, 0], [1, 0, 0], [2, 0, 0]]), ("point", [[1, 1, 1]] * 3)):
        trimesh.Trimesh(corners, [[0, 1, 2]], process=False).export(tmp_path / f"{name}.ply")
        with pytest.raises(ValueError, match=rf"{name}.ply cannot be read as a triangle mesh.*none of its faces has"):
            load_solid(tmp_path / f"{name}.ply")
