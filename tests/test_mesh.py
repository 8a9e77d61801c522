"""Triangles from a field."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from skimage.measure import marching_cubes

from distrace.errors import DoubtfulResult
from distrace.fields import primitives
from distrace.fields.base import SDF
from distrace.mesh import MeshConfig, extract_mesh, mesh_in_world, save_mesh
from distrace.pose import Similarity

COARSE = MeshConfig(resolution=48)
BALL, PLATE = primitives.sphere(0.6), primitives.box(torch.tensor([0.6, 0.05, 0.5]))


def test_a_sphere_has_its_volume_and_area_and_is_closed() -> None:
    mesh = extract_mesh(primitives.sphere(0.6), COARSE)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.6**3, rel=5e-3)
    assert mesh.area == pytest.approx(4 * math.pi * 0.6**2, rel=5e-3)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.6).max() < 1e-3


@pytest.mark.parametrize("factor", [3.0, 100.0])
def test_a_field_that_is_steeper_than_a_distance_has_the_same_mesh(factor: float) -> None:
    mesh, steep = (extract_mesh(sdf, COARSE) for sdf in (BALL, lambda points: factor * BALL(points)))
    assert np.abs(steep.vertices - mesh.vertices).max() < 1e-5
    thin = extract_mesh(lambda points: torch.tanh(6 * PLATE(points)), COARSE)
    assert thin.is_watertight
    assert thin.area == pytest.approx(extract_mesh(PLATE, COARSE).area, rel=0.01)


def test_a_grid_that_no_memory_holds_is_refused() -> None:
    with pytest.raises(ValueError, match="100000000 was given"):
        MeshConfig(100_000_000)


def test_normals_point_out() -> None:
    centre = torch.tensor([0.2, -0.1, 0.1])
    mesh = extract_mesh(primitives.sphere(0.4, centre), COARSE)
    outward = mesh.triangles_center - centre.numpy()
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    sized = mesh.area_faces > 1e-8
    assert (mesh.face_normals * outward).sum(axis=1)[sized].min() > 0.9


def test_vertices_lie_where_the_field_is_zero_in_axes_of_the_world() -> None:
    """Nothing is flipped or shifted: the box has another length along each axis, and a bump on one side."""
    sdf = primitives.union(
        primitives.box(torch.tensor([0.5, 0.3, 0.15])), primitives.sphere(0.2, torch.tensor([0.5, 0.3, 0.0]))
    )
    mesh = extract_mesh(sdf, MeshConfig(resolution=64))
    cell = 2 / 64
    assert sdf(torch.tensor(mesh.vertices).float()).abs().max() < cell / 4
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -0.3, -0.2], [0.7, 0.5, 0.2]], atol=cell / 2)


def test_a_torus_keeps_its_hole() -> None:
    mesh = extract_mesh(primitives.torus(0.5, 0.2), COARSE)
    assert mesh.is_watertight
    assert mesh.euler_number == 0


def test_cells_are_passed_over_only_where_there_is_no_surface() -> None:
    """The same triangles as on the whole grid, from a fraction of its values."""
    evaluations = 0
    thin = primitives.box(torch.tensor([0.71, 0.02, 0.43]))

    def watched(points: torch.Tensor) -> torch.Tensor:
        nonlocal evaluations
        evaluations += len(points)
        return thin(points)

    mesh = extract_mesh(watched, MeshConfig(resolution=64))
    ticks = torch.linspace(-1, 1, 65)
    grid = thin(torch.cartesian_prod(ticks, ticks, ticks)).reshape(65, 65, 65).numpy()
    vertices, faces, _, _ = marching_cubes(grid, 0.0)
    assert len(mesh.faces) == len(faces)
    np.testing.assert_allclose(np.sort(mesh.vertices, axis=0), np.sort(vertices / 32 - 1, axis=0), atol=1e-5)
    assert evaluations < 65**3 / 4


def test_what_is_beyond_the_ball_is_no_part_of_the_shape() -> None:
    """There a decoder was never trained, and no ray is marched."""
    corner, edge = (primitives.sphere(0.2, torch.tensor(3 * [middle])) for middle in (0.8, -0.55))
    mesh = extract_mesh(primitives.union(primitives.union(primitives.sphere(0.4), corner), edge), COARSE)
    assert mesh.is_watertight
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 1 + 1 / 48
    assert len(mesh.split()) == 2


def test_a_larger_ball_holds_a_larger_shape() -> None:
    mesh = extract_mesh(primitives.sphere(1.5), MeshConfig(resolution=48, radius=2.0))
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 1.5**3, rel=1e-2)


@pytest.mark.parametrize(
    "sdf",
    [primitives.sphere(0.3, torch.tensor([0, 9.0, 0])), primitives.sphere(9.0), lambda p: 0.01 + 0 * p[..., 0]],
    ids=["elsewhere", "inside everywhere", "close to zero, but nowhere zero"],
)
def test_a_field_without_a_surface_is_told_so(sdf) -> None:
    with pytest.raises(ValueError, match=r"no zero within 1\.0 of the origin"):
        extract_mesh(sdf, MeshConfig(resolution=16))


@pytest.mark.parametrize("resolution", [0, 4, 20, -8])
def test_a_resolution_that_cannot_be_halved_is_refused(resolution: int) -> None:
    with pytest.raises(ValueError, match=f"resolution of {resolution}"):
        MeshConfig(resolution=resolution)


def undefined(where: str) -> SDF:
    """A ball of radius 0.6 that is NaN in part."""
    parts = {
        "on the surface": lambda points: points[..., 0] > 0.4,
        "inside": lambda points: points.norm(dim=-1) < 0.3,
        "beyond the ball": lambda points: points.norm(dim=-1) > 1.01,
    }
    return lambda points: BALL(points).masked_fill(parts[where](points), torch.nan)


@pytest.mark.parametrize("where", ["on the surface", "inside"])
def test_a_field_that_is_nan_in_part_is_warned_of(where: str) -> None:
    with pytest.warns(DoubtfulResult, match=r"NaN at [\d,]+ of [\d,]+ points within 1\.0 of the origin") as said:
        mesh = extract_mesh(undefined(where), COARSE)
    assert len(said) == 1
    assert mesh.is_watertight == (where == "inside")


def test_a_field_that_is_nan_everywhere_is_refused_as_such() -> None:
    with pytest.raises(ValueError, match=r"the field is NaN at .* there is no surface to extract"):
        extract_mesh(lambda points: points[..., 0] * torch.nan, MeshConfig(resolution=16))


def test_an_inverted_field_is_warned_of() -> None:
    with pytest.warns(DoubtfulResult, match=r"negative at 32 of 32 points .* is its sign inverted\?") as said:
        mesh = extract_mesh(lambda points: -BALL(points), COARSE)
    assert len(said) == 1
    assert mesh.area > 3 * extract_mesh(BALL, COARSE).area, "also what is around it"
    with pytest.warns(DoubtfulResult, match="at 2.0 from the origin"):
        extract_mesh(lambda points: -BALL(points), MeshConfig(resolution=48, radius=2.0))


@pytest.mark.parametrize(
    "sdf",
    [
        BALL,
        undefined("beyond the ball"),
        primitives.plane(torch.tensor([0.0, 1.0, 0.0]), 0.3),
        primitives.difference(BALL, primitives.sphere(0.4)),
    ],
    ids=["ball", "NaN beyond the ball", "floor", "hollow"],
)
def test_other_fields_are_not_warned_of(sdf: SDF) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        extract_mesh(sdf, COARSE)


def test_a_mesh_moves_as_its_object_does_to_the_last_digit_of_a_double() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).double()
    place = Similarity(turn, torch.tensor([4e6, 5.0, -7.0]).double(), torch.tensor(0.25).double())
    moved = mesh_in_world(ball, place)
    assert np.abs(moved.vertices - place.to_world(torch.tensor(ball.vertices)).numpy()).max() < 1e-8
    assert (moved.faces == ball.faces).all()
    assert np.abs(ball.vertices).max() <= 1, "the mesh itself stays"


@pytest.mark.parametrize("kind", ["ply", "glb", "obj"])
def test_a_mesh_is_one_file_that_keeps_the_colours_of_its_vertices(kind: str, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.visual.vertex_colors = np.rint(127.5 * (ball.vertices + 1)).astype(np.uint8)
    save_mesh(tmp_path / f"mesh.{kind}", ball)
    assert [path.name for path in tmp_path.iterdir()] == [f"mesh.{kind}"]
    read = trimesh.load(tmp_path / f"mesh.{kind}", process=False, force="mesh")
    assert read.vertices == pytest.approx(ball.vertices, abs=1e-6)
    assert (read.faces == ball.faces).all()
    stored = ball.visual.vertex_colors[:, :3]
    if kind == "glb":
        stored = np.rint(255 * linear_light(stored / 255))
    assert (read.visual.vertex_colors[:, :3] == stored).all()


def linear_light(srgb: np.ndarray) -> np.ndarray:
    """Returns light from 0 to 1 by a table of the encoding, read backwards."""
    light = np.linspace(0, 1, 100_001)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.interp(srgb, encoded, light)
