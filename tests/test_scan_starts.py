"""Starts of scans: rotations about up or anywhere, and the true place among the ends."""

import math

import pytest
import roma
import torch

from distrace.data.scan import scan_of_points
from distrace.data.up import Up
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.fitting.fit_scan import ScanFitConfig, fit_scan
from distrace.fitting.scan_residuals import PlacedCode
from distrace.fitting.scan_starts import (
    TRIED_TURNS,
    Starts,
    axes_around,
    placement_prior,
    turns_about,
)
from distrace.pose import Similarity
from distrace.prior import prior_of

TRUE = Similarity(
    roma.rotvec_to_rotmat(torch.tensor([0.0, 0.6, 0.0])), torch.tensor([10.0, -4.0, 3.0]), torch.tensor(5.0)
)


@pytest.mark.parametrize("axis", [*axes_around(), torch.tensor([0.0, -0.8, -0.6])])
def test_all_turns_about_up_are_rotations(axis: torch.Tensor) -> None:
    rotations = turns_about(axis)
    assert len(rotations) == TRIED_TURNS
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).expand(TRIED_TURNS, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(TRIED_TURNS))
    torch.testing.assert_close(rotations[:, :, 1], axis.expand(TRIED_TURNS, 3), atol=1e-6, rtol=0)
    step = roma.rotmat_geodesic_distance(rotations[0], rotations[1])
    assert float(step) == pytest.approx(2 * math.pi / TRIED_TURNS, abs=1e-4)


def test_an_unknown_up_is_near_to_one_that_is_tried() -> None:
    axes = axes_around()
    torch.testing.assert_close(axes.norm(dim=-1), torch.ones(26))
    anywhere = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert float((anywhere @ axes.T).amax(1).min()) > math.cos(math.radians(33))


def test_joined_starts_are_numbered_anew() -> None:
    prior = prior_of(torch.randn(5, 4, generator=torch.Generator().manual_seed(0)))
    scan = scan_of_points(TRUE.to_world(box_points(100)), Up.along("y"))
    one = Starts([PlacedCode.at(TRUE, prior.mean)], [placement_prior(TRUE, scan)], 3)
    assert [state.start for state in (one + one).states] == [0, 1]
    assert (one + one).evaluations == 6
    assert placement_prior(TRUE, scan).size == pytest.approx(5.0)


def boxes() -> tuple[Decoder, torch.Tensor]:
    """A decoder whose shapes are boxes of nearly one size: |x|, |y| and |z| less a half-width."""
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


def test_a_model_without_a_network_is_placed_too() -> None:
    decoder, codes = boxes()
    scan = scan_of_points(TRUE.to_world(box_points(3000)), Up.along("y"))
    found = fit_scan(decoder, scan, prior_of(codes), ScanFitConfig()).place
    half_turn = roma.rotvec_to_rotmat(torch.tensor([0.0, math.pi, 0.0]))
    turns = (TRUE.rotation, TRUE.rotation @ half_turn)
    assert min(float(roma.rotmat_geodesic_distance(found.rotation, turn)) for turn in turns) < math.radians(5)
    assert float((found.translation - TRUE.translation).norm()) < 0.25
    assert float(found.scale) == pytest.approx(5.0, rel=0.1)
