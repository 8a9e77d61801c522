"""Derivatives of every quantity by every parameter: implicit, by finite differences, and of closed forms."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from distrace.camera import Camera
from distrace.checking.differences import Images, image_derivatives
from distrace.checking.gradcheck import check_gradients
from distrace.checking.moves import Move, all_moves
from distrace.checking.retrace import DOUBLE, Retraced
from distrace.fields import primitives
from distrace.fields.base import SDF

f64 = torch.float64
RADIUS, CENTRE = 0.5, torch.tensor([0.1, -0.05, 0.2], dtype=f64)
HALF = torch.tensor([0.5, 0.3, 0.4], dtype=f64)
VIEW = Camera.orbit(30, 20, 4.97, height=24, width=24, dtype=f64)
ABOVE = Camera.orbit(-50, 60, 3.0, height=24, width=24, focal_px=30.0, dtype=f64)
HITS = {"distance", "depth", "hit points", "normal"}

FIELDS: dict[str, tuple[SDF, Callable[[Tensor], SDF]]] = {
    "sphere": (primitives.sphere(RADIUS, CENTRE), lambda h: primitives.sphere(RADIUS + h, CENTRE)),
    "box": (primitives.box(HALF), lambda h: primitives.box(HALF + h)),
    "torus": (primitives.torus(0.5, 0.2), lambda h: primitives.torus(0.5 + h, 0.2)),
}


@pytest.mark.parametrize("camera", [VIEW, ABOVE], ids=["far", "near"])
@pytest.mark.parametrize("name", FIELDS)
def test_autograd_and_finite_differences_agree_on_every_quantity_of_a_hit(name: str, camera: Camera) -> None:
    field, size = FIELDS[name]
    found = check_gradients(field, camera, parameters={"size": size}, size=24)
    for row in found.rows:
        if row.quantity in HITS:
            assert row.verdict != "disagrees", row
            assert row.agrees or (name, row.quantity) == ("box", "normal"), "only those of flat faces are constant"
            assert row.worst < 1e-4, row
            assert row.pixels > 50 or name == "box", row
            assert row.left_out < 0.1 * row.pixels, row


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_autograd_and_finite_differences_agree_on_clearance(name: str) -> None:
    """Where the surface is round; the least value beside a sharp edge is another matter."""
    field, size = FIELDS[name]
    found = check_gradients(field, VIEW, parameters={"size": size}, size=24)
    rows = [row for row in found.rows if row.quantity == "clearance"]
    assert len(rows) == 6
    assert all(row.agrees and row.pixels > 30 for row in rows), rows


def met(sdf: SDF, camera: Camera, moved: str) -> tuple[Retraced, dict[str, Move]]:
    return Retraced.of(sdf, camera, 1.0, DOUBLE), dict(all_moves(sdf, camera, {})[moved])


def images(camera: Camera, distance: Tensor, hit: Tensor, normal: Tensor) -> Images:
    depth = (distance * camera.cosines())[hit]
    points = camera.rays()[hit].at(distance[hit])
    return {"distance": distance[hit], "depth": depth, "hit points": points, "normal": normal[hit]}


def of_sphere(camera: Camera, centre: Tensor, radius: Tensor, hit: Tensor) -> Images:
    """The nearer root of |o + t v − c|² = r²."""
    rays = camera.rays()
    towards = rays.origins - centre
    b, c = (towards * rays.directions).sum(-1), towards.square().sum(-1) - radius**2
    distance = -b - (b**2 - c).clamp_min(1e-12).sqrt()
    return images(camera, distance, hit, (rays.at(distance) - centre) / radius)


def transformed(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """The centre and the radius of the sphere in a similarity's world."""
    return matrix[:3, :3] @ CENTRE + matrix[:3, 3], RADIUS * torch.linalg.det(matrix[:3, :3]) ** (1 / 3)


def generator(along: str) -> Tensor:
    """Of the similarity that a component of the placement moves along, written from its definition."""
    matrix = torch.zeros(4, 4, dtype=f64)
    if along == "scale":
        matrix[:3, :3] = torch.eye(3)
        return matrix
    kind, axis = along.split()
    if kind == "translation":
        matrix["xyz".index(axis), 3] = 1
        return matrix
    unit = torch.eye(3, dtype=f64)["xyz".index(axis)]
    matrix[:3, :3] = torch.linalg.cross(unit.expand(3, 3), torch.eye(3, dtype=f64)).T
    return matrix


def assert_same(found: Images, expected: Images, least: float) -> None:
    for name, slopes in expected.items():
        scale = slopes.abs().max()
        assert scale > least, name
        torch.testing.assert_close(found[name], slopes, rtol=0, atol=float(1e-8 * scale), msg=name)


@pytest.mark.parametrize("parameter", ["camera rotation", "camera translation", "focal length", "principal point"])
def test_the_cameras_derivatives_are_those_of_the_closed_form(parameter: str) -> None:
    sdf = FIELDS["sphere"][0]
    view, moves = met(sdf, VIEW, parameter)
    for move in moves.values():
        attached = image_derivatives(lambda h, move=move: view.attached(*move(h)), view.slope)
        closed = image_derivatives(
            lambda h, move=move: of_sphere(move(h)[1], CENTRE, CENTRE.new_tensor(RADIUS), view.trace.hit), view.slope
        )
        assert_same(attached, closed, 1e-3)


def test_the_placements_derivatives_are_those_of_the_closed_form() -> None:
    sdf = FIELDS["sphere"][0]
    view, moves = met(sdf, VIEW, "placement")
    assert len(moves) == 7
    for along, move in moves.items():
        attached = image_derivatives(lambda h, move=move: view.attached(*move(h)), view.slope)
        closed = image_derivatives(
            lambda h, along=along: of_sphere(
                VIEW, *transformed(torch.linalg.matrix_exp(h * generator(along))), view.trace.hit
            ),
            view.slope,
        )
        assert_same(attached, closed, 1e-3)


def of_plane(camera: Camera, height: Tensor, hit: Tensor) -> Images:
    """The roof of the box: o_y + t v_y = height."""
    rays = camera.rays()
    distance = (height - rays.origins[..., 1]) / rays.directions[..., 1]
    up = normalize(torch.tensor([0.0, 1, 0], dtype=f64), dim=-1)
    return images(camera, distance, hit, up.expand(*distance.shape, 3))


@pytest.mark.parametrize("parameter", ["camera rotation", "camera translation", "focal length", "principal point"])
def test_on_a_face_of_a_box_they_are_those_of_its_plane(parameter: str) -> None:
    view, moves = met(FIELDS["box"][0], ABOVE, parameter)
    roof = view.trace.hit & ((ABOVE.rays().at(view.trace.distance)[..., 1] - HALF[1]).abs() < 1e-9)
    assert roof.sum() > 50
    among, largest = roof[view.trace.hit], 0.0
    for move in moves.values():
        attached = image_derivatives(lambda h, move=move: view.attached(*move(h)), view.slope)
        closed = image_derivatives(lambda h, move=move: of_plane(move(h)[1], HALF[1], roof), view.slope)
        for name in ("distance", "depth", "hit points", "normal"):
            torch.testing.assert_close(attached[name][among], closed[name], rtol=1e-8, atol=1e-8, msg=name)
        largest = max(largest, float(closed["distance"].abs().max()))
    assert largest > 1e-3


def test_the_turn_of_the_camera_is_about_its_own_axis_by_radians() -> None:
    moves = all_moves(FIELDS["sphere"][0], VIEW, {})["camera rotation"]
    for k, move in enumerate(moves.values()):
        _, turned = move(torch.tensor(0.3, dtype=f64))
        relative = torch.linalg.inv(VIEW.T_world_camera) @ turned.T_world_camera
        torch.testing.assert_close(relative[:3, k], torch.eye(3, dtype=f64)[k])
        assert relative[:3, :3].trace().item() == pytest.approx(1 + 2 * torch.tensor(0.3).cos().item())
        assert relative[(k + 2) % 3, (k + 1) % 3] > 0


def test_a_longer_lens_and_a_shifted_sensor_are_relative_to_their_size() -> None:
    moves = all_moves(FIELDS["sphere"][0], VIEW, {})
    before, h = VIEW.intrinsics, torch.tensor(0.5, dtype=f64)
    _, longer = moves["focal length"][""](h)
    torch.testing.assert_close(longer.intrinsics[[0, 1], [0, 1]], 1.5 * before[[0, 1], [0, 1]])
    _, shifted = moves["principal point"]["y"](h)
    assert (shifted.intrinsics - before)[1, 2] == 12
    assert (shifted.intrinsics - before).count_nonzero() == 1


def test_rays_of_a_moved_camera_are_those_that_are_compared() -> None:
    """The view is seen through the moved camera, not through its own."""
    sdf = FIELDS["sphere"][0]
    view = Retraced.of(sdf, VIEW, 1.0, DOUBLE)
    nearer = replace(VIEW, T_world_camera=VIEW.T_world_camera.clone())
    nearer.T_world_camera[:3, 3] *= 1 - 1e-7
    moved, here = view.retraced(sdf, nearer), view.retraced(sdf, VIEW)
    assert (moved["distance"] < here["distance"]).all()
    exact = of_sphere(nearer, CENTRE, CENTRE.new_tensor(RADIUS), view.trace.hit)
    for name, image in exact.items():
        torch.testing.assert_close(moved[name], image, rtol=0, atol=1e-9)
