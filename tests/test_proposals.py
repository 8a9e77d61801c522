"""Proposals: rotations about up or anywhere, typical shapes, and the right place among the first."""

import math

import pytest
import roma
import torch

from distrace.data.scan import scan_of_points
from distrace.data.up import Up
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.fitting.proposals import SHAPES, TURNS, Volumes, _rotations, proposed, typical_codes
from distrace.pose import Similarity
from distrace.prior import prior_of


@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, -0.8, -0.6), (-1.0, 0.0, 0.0)])
def test_all_turns_about_up_are_rotations(up: tuple[float, float, float]) -> None:
    axis = torch.tensor(up)
    rotations = _rotations(axis[None])
    assert len(rotations) == TURNS
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).expand(TURNS, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(TURNS))
    torch.testing.assert_close(rotations[:, :, 1], axis.expand(TURNS, 3), atol=1e-6, rtol=0)
    step = roma.rotmat_geodesic_distance(rotations[0], rotations[1])
    assert float(step) == pytest.approx(2 * math.pi / TURNS, abs=1e-4)


def test_an_unknown_up_is_near_to_one_that_is_tried() -> None:
    rotations = _rotations(torch.empty(0, 3))
    for rotation in roma.random_rotmat(50):
        nearest = roma.rotmat_geodesic_distance(rotations, rotation.expand(len(rotations), 3, 3)).min()
        assert float(nearest) < math.radians(37)


def test_typical_codes_are_training_codes_and_not_too_many() -> None:
    codes = torch.randn(200, 8, generator=torch.Generator().manual_seed(0))
    chosen = typical_codes(prior_of(codes), 0)
    assert 0 < len(chosen) <= SHAPES
    assert (chosen[:, None] == codes).all(-1).any(1).all()
    assert len(typical_codes(prior_of(codes[:5]), 0)) == 5


def blob() -> tuple[Decoder, torch.Tensor]:
    """A decoder whose shapes are boxes: |x|, |y| and |z| less a half-width that the code changes."""
    decoder = Decoder(NetworkSpecs(dims=(6, 3), code_length=2, latent_in=(), norm_layers=()))
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter.zero_()
        decoder.lin0.weight[:3, 2:] = torch.eye(3)
        decoder.lin0.weight[3:, 2:] = -torch.eye(3)
        decoder.lin1.weight[:] = torch.tensor([[1.0, 0, 0, 1, 0, 0], [0, 1, 0, 0, 1, 0], [0, 0, 1, 0, 0, 1]])
        decoder.lin1.bias[:] = torch.tensor([-0.7, -0.4, -0.2])
        decoder.lin2.weight[:] = 1.0
        decoder.lin2.bias[:] = -1e-2
    return decoder, 0.01 * torch.randn(6, 2, generator=torch.Generator().manual_seed(0))


def box_points(count: int) -> torch.Tensor:
    """Points on a box of the half-widths 0.7, 0.4 and 0.2."""
    half = torch.tensor([0.7, 0.4, 0.2])
    points = 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 1
    side = torch.randint(3, (count,), generator=torch.Generator().manual_seed(1))
    points[torch.arange(count), side] = points[torch.arange(count), side].sign()
    return half * points


def test_values_of_volumes_are_those_of_the_field() -> None:
    decoder, codes = blob()
    volumes = Volumes.of(decoder, prior_of(codes), 0)
    points = 0.9 * (2 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 1)
    points = points[points.norm(dim=-1) < 0.9]
    exact = decoder.fields(volumes.codes)(points.expand(len(volumes.codes), -1, -1)).T
    assert (volumes.at(points) - exact).abs().max() < 0.12
    assert volumes.only(2).at(points).equal(volumes.at(points)[:, 2:3])


def test_the_true_place_is_among_the_first_proposals() -> None:
    decoder, codes = blob()
    prior = prior_of(codes)
    turn = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.6, 0.0]))
    true = Similarity(turn, torch.tensor([10.0, -4.0, 3.0]), torch.tensor(5.0))
    scan = scan_of_points(true.to_world(box_points(3000)), Up.along("y"))
    with torch.no_grad():
        found = proposed(scan, decoder, prior, 6, 0)
    assert [each.start for each in found] == list(range(6))
    half_turn = roma.rotvec_to_rotmat(torch.tensor([0.0, math.pi, 0.0]))
    best = found[0].place
    apart = [float(roma.rotmat_geodesic_distance(best.rotation, turn @ also)) for also in (torch.eye(3), half_turn)]
    assert min(apart) < math.radians(20)
    assert float((best.translation - true.translation).norm()) < 1.0
    assert float(best.scale) == pytest.approx(5.0, rel=0.2)
