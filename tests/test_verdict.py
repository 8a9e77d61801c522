"""What of a view a surface contradicts: depths up to a limit, and the share of the silhouette that is wrong."""

from dataclasses import replace

import pytest
import torch

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.fields.base import SDF
from distrace.fields.batch import BatchField
from distrace.fields.primitives import sphere
from distrace.fitting.code_residuals import Comparison
from distrace.fitting.observations import Seen
from distrace.fitting.ray_sampling import Pool
from distrace.fitting.verdict import MOST, contradictions
from distrace.losses import Weights
from distrace.render import render
from distrace.tracing.sphere_tracing import TraceConfig

CAMERA = Camera.orbit(30, 20, 3.0, height=48, width=48, focal_px=60.0)
TRACE = Comparison().trace


def seen(depths: int = 500) -> Seen:
    """A ball of radius 0.5."""
    buffers = render(sphere(0.5), CAMERA)
    view = View(CAMERA, buffers.depth, buffers.mask)
    pool = Pool.of(view.without("depth") if not depths else view)
    return Seen.of([pool.draw(depths, 3000, torch.Generator().manual_seed(0))], Weights())


def contradiction(sdf: SDF, some: Seen, trace: TraceConfig) -> float:
    """The verdict on a single shape."""
    (verdict,) = contradictions(batch(sdf), some, trace)
    return verdict


def batch(*sdfs: SDF) -> BatchField:
    """A field of several shapes in closed form."""

    def evaluate(points: torch.Tensor, shape: torch.Tensor) -> torch.Tensor:
        return torch.stack([sdf(points) for sdf in sdfs]).gather(0, shape[None])[0]

    return BatchField(torch.zeros(len(sdfs), 1), evaluate, lambda code: sdfs[0])


def test_several_shapes_are_judged_as_each_alone() -> None:
    shapes = [sphere(radius) for radius in (0.5, 0.4, 0.6)]
    expected = [contradiction(shape, seen(), TRACE) for shape in shapes]
    assert contradictions(batch(*shapes), seen(), TRACE) == pytest.approx(expected)
    assert len(set(expected)) == 3


def test_what_was_seen_contradicts_nothing() -> None:
    assert contradiction(sphere(0.5), seen(), TRACE) < 5e-3


@pytest.mark.parametrize("radius", [0.45, 0.55])
def test_depths_that_are_off_do(radius: float) -> None:
    assert 0.05 < contradiction(sphere(radius), seen(), TRACE) < 2 * MOST, "no ray is nearer than the radii are"


@pytest.mark.parametrize("radius", [0.4, 0.6])
def test_outlines_that_are_off_do(radius: float) -> None:
    some = seen(0)
    nearest = torch.linalg.cross(some.rays.origins, some.rays.directions).norm(dim=-1)
    ball, found = nearest < 0.5, nearest < radius
    share = (ball != found).sum() / (ball | found).sum()
    assert contradiction(sphere(radius), some, TRACE) == pytest.approx(MOST * float(share), rel=0.1)


def test_no_ray_counts_for_more_than_it_can_tell() -> None:
    assert contradiction(sphere(0.01), seen(), TRACE) == pytest.approx(2 * MOST, rel=0.05)


def test_noise_that_is_known_contradicts_nothing() -> None:
    exact, random = seen(3000), torch.Generator().manual_seed(1)
    off = 0.05 * torch.randn(len(exact.observed), generator=random)
    noisy = replace(exact, observed=exact.observed + off, noise=0.05 * exact.known)
    assert contradiction(sphere(0.5), noisy, TRACE) == pytest.approx(0, abs=4e-3)
    assert contradiction(sphere(0.5), replace(noisy, noise=exact.noise), TRACE) > 0.03, "where it isn't known it does"
    assert contradiction(sphere(0.6), noisy, TRACE) > 0.03
