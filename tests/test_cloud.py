"""Points without a camera: reading them, what is wrong with them, and what of them a camera sees."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from distrace.camera import Camera
from distrace.data.cloud import Cloud, load_cloud, read_points
from distrace.errors import DoubtfulResult

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.6)


def ply(path: Path, points: np.ndarray, names: str = "x y z") -> Path:
    head = "ply\nformat ascii 1.0\n" + f"element vertex {len(points)}\n"
    head += "".join(f"property float {name}\n" for name in names.split()) + "end_header\n"
    path.write_text(head + "\n".join(" ".join(map(str, point)) for point in points.tolist()) + "\n")
    return path


def test_a_cloud_is_read_with_its_normals_made_unit_length(tmp_path: Path) -> None:
    vertices = np.asarray(BALL.vertices)
    plain = load_cloud(ply(tmp_path / "plain.ply", vertices))
    np.testing.assert_allclose(plain.points.numpy(), vertices, atol=1e-6)
    assert plain.normals is None
    both = load_cloud(ply(tmp_path / "both.ply", np.hstack([vertices, 3 * vertices]), "x y z nx ny nz"))
    assert both.normals is not None
    np.testing.assert_allclose(both.normals.numpy(), vertices / 0.6, atol=1e-5)


@pytest.mark.parametrize("binary", [True, False])
def test_a_mesh_is_its_vertices_and_its_normals_are_only_those_of_the_file(tmp_path: Path, binary: bool) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(BALL.export(file_type="ply", encoding="binary" if binary else "ascii", vertex_normal=False))
    assert load_cloud(path).normals is None
    path.write_bytes(BALL.export(file_type="ply", encoding="binary" if binary else "ascii", vertex_normal=True))
    normals = load_cloud(path).normals
    assert normals is not None
    np.testing.assert_allclose(normals.numpy(), BALL.vertex_normals, atol=1e-5)


@pytest.mark.parametrize(
    ("points", "names", "reason"),
    [
        (np.asarray(BALL.vertices) * 1000, "x y z", r"points lie 600 from the origin .* divide by its largest radius"),
        (np.asarray(BALL.vertices) * 1e-3, "x y z", r"points lie 0\.0006 from the origin"),
        (np.full((5, 3), np.nan), "x y z", "it has 5 points, and none that is finite"),
        (np.zeros((0, 3)), "x y z", "cannot be read|it has 0 points"),
    ],
)
def test_what_makes_no_sense_is_told_in_one_sentence(
    tmp_path: Path, points: np.ndarray, names: str, reason: str
) -> None:
    path = ply(tmp_path / "cloud.ply", points, names)
    with pytest.raises(ValueError, match=reason) as caught:
        load_cloud(path)
    assert str(path) in str(caught.value)


def with_normals() -> np.ndarray:
    vertices = np.array(BALL.vertices)
    return np.hstack([vertices, vertices])


def test_points_that_are_not_finite_or_have_no_normal_are_dropped_and_counted(tmp_path: Path) -> None:
    points = with_normals()
    points[3, 1] = np.nan
    points[8, 3:] = 0
    points[9, 4] = np.nan
    with pytest.warns(DoubtfulResult, match=r"cloud\.ply: 3 points .* were dropped"):
        cloud = load_cloud(ply(tmp_path / "cloud.ply", points, "x y z nx ny nz"))
    assert cloud.normals is not None
    for read, kept in ((cloud.points, BALL.vertices), (cloud.normals, np.array(BALL.vertices) / 0.6)):
        np.testing.assert_allclose(read.numpy(), np.delete(kept, [3, 8, 9], axis=0), atol=1e-5)


def test_normals_that_are_mostly_zero_are_not_used_and_the_points_are(tmp_path: Path) -> None:
    points = with_normals()
    points[5:, 3:] = 0
    with pytest.warns(DoubtfulResult, match="most of its normals have no direction, and none is used"):
        cloud = load_cloud(ply(tmp_path / "cloud.ply", points, "x y z nx ny nz"))
    assert cloud.normals is None
    assert len(cloud.points) == len(points)


def test_a_comment_that_is_not_utf8_is_no_obstacle(tmp_path: Path) -> None:
    path = ply(tmp_path / "cloud.ply", np.asarray(BALL.vertices))
    path.write_bytes(path.read_bytes().replace(b"element", b"comment caf\xe9\nelement", 1))
    assert len(load_cloud(path).points) == len(BALL.vertices)


@pytest.mark.parametrize("content", [b"", b"no cloud\n", None], ids=["empty", "words", "missing"])
def test_what_is_no_cloud_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "cloud.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match="cannot be read as a cloud of points" if path.exists() else "does not exist"):
        load_cloud(path)


def test_points_are_seen_where_they_are_the_nearest_of_a_pixel() -> None:
    camera = Camera.orbit(0, 0, 3.0, height=8, width=8, focal_px=8.0)
    points = torch.tensor([[0.02, -0.02, 0.5], [0.02, -0.02, -0.5], [0.9, 0.02, 0.0], [0.0, 0.0, 5.0]])
    view = Cloud(points).seen_from(camera)
    assert view.seen.sum() == 2
    assert view.depth[4, 4].item() == pytest.approx(2.5)
    assert view.depth[3, 6].item() == pytest.approx(3.0)


def test_a_part_keeps_points_and_normals_together() -> None:
    points = torch.rand(40, 3)
    part = Cloud(points, points).sparse(7, seed=1)
    assert part.normals is not None
    assert torch.equal(part.points, part.normals)
    assert len(part.points) == 7


def test_a_file_of_one_point_is_read(tmp_path: Path) -> None:
    (tmp_path / "one.xyz").write_text("0.1 0.2 0.3\n")
    assert read_points(tmp_path / "one.xyz").tolist() == [[0.1, 0.2, 0.3]]
