"""What a view contradicts of a mesh: balls beside, before, behind and within what was seen."""

from dataclasses import replace

import pytest
import torch
import trimesh

from distrace.camera import Camera
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.data.solid import Solid
from distrace.fields.base import SDF
from distrace.fitting.free_space import MARGIN, PRUNED_PIECES, free_space, prune_pieces, pruned_mesh
from distrace.mesh import MeshConfig
from experiments.datasets.solids import observe

BESIDE, BEFORE, BEHIND = (0.7, 0.0, 0.0), (0.0, 0.0, 0.7), (0.0, 0.0, -0.7)


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    found = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    found.apply_translation(centre)
    return found


@pytest.fixture(scope="module")
def view() -> View:
    """Of a ball, along z."""
    return observe(Solid(ball(0.5), ball(0.5)), Camera.orbit(0, 0, 4, height=96, width=96))


def pieces(mesh: trimesh.Trimesh) -> int:
    return mesh.body_count


@pytest.mark.parametrize(
    ("centre", "known", "left"),
    [
        (BESIDE, (), 1),
        (BESIDE, ("mask",), 2),
        (BEFORE, (), 1),
        (BEFORE, ("depth",), 2),
        (BEHIND, (), 2),
    ],
)
def test_what_is_seen_to_be_free_loses_its_piece(
    view: View, centre: tuple[float, float, float], known: tuple[str, ...], left: int
) -> None:
    mesh = trimesh.util.concatenate([ball(0.5), ball(0.08, centre)])
    found = prune_pieces(mesh, view.without(*known))
    assert pieces(found) == left == 2 - found.metadata.get(PRUNED_PIECES, 0)
    assert found.area == pytest.approx(ball(0.5).area + (left - 1) * ball(0.08).area)


def test_a_piece_within_the_margin_stays(view: View) -> None:
    beside = (0.5 + 0.01 + 0.002, 0.0, 0.0)
    mesh = trimesh.util.concatenate([ball(0.5), ball(0.01, beside)])
    assert pieces(prune_pieces(mesh, view)) == 2
    further = (0.5 + 0.01 + 2 * MARGIN, 0.0, 0.0)
    assert pieces(prune_pieces(trimesh.util.concatenate([ball(0.5), ball(0.01, further)]), view)) == 1


def test_what_is_connected_stays_and_so_does_the_largest_piece(view: View) -> None:
    arm = trimesh.boolean.union([ball(0.5), ball(0.3, (0.6, 0.0, 0.0))])
    assert prune_pieces(arm, view) is arm
    alone = trimesh.util.concatenate([ball(0.3, BESIDE), ball(0.2, (-0.75, 0.0, 0.0))])
    assert prune_pieces(alone, view).area == pytest.approx(ball(0.3).area)


def test_nothing_is_known_outside_of_the_image_and_behind_the_camera(view: View) -> None:
    points = torch.tensor([[0.0, 0, 0.9], [3.0, 0, 0], [0, 0, 9.0], [0.0, 0, 0]]).double().numpy()
    assert free_space(view, points).tolist() == [True, False, False, False]


def test_sparse_depths_tell_only_where_they_are(view: View) -> None:
    mesh = trimesh.util.concatenate([ball(0.5), ball(0.08, BEFORE)])
    assert pieces(prune_pieces(mesh, view.sparse(20))) == 2


def test_of_a_field_the_same(view: View) -> None:
    def balls(points: torch.Tensor) -> torch.Tensor:
        first, second = points.norm(dim=-1) - 0.5, (points - points.new_tensor(BESIDE)).norm(dim=-1) - 0.08
        return torch.minimum(first, second)

    field: SDF = balls
    config = MeshConfig(64)
    assert pieces(pruned_mesh(field, view, config)) == 1
    assert pieces(pruned_mesh(field, replace(view, mask=None), config)) == 2
    assert pieces(pruned_mesh(field, Cloud(view.points()), config)) == 2
