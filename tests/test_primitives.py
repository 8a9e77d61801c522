"""Analytic fields against closed forms, and the property that marching needs: none changes faster than one moves."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from distrace.fields import primitives
from distrace.fields.base import SDF, value_and_gradient
from distrace.fields.primitives import _length

f64 = torch.float64


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=f64)


EXACT = {
    "sphere": primitives.sphere(0.5, vector(0.1, -0.2, 0.3)),
    "plane": primitives.plane(vector(1, 2, -2), 0.2),
    "box": primitives.box(vector(0.3, 0.5, 0.2)),
    "torus": primitives.torus(0.5, 0.2),
    "capsule": primitives.capsule(vector(-0.3, 0, 0.1), vector(0.4, 0.2, 0), 0.2),
    "cylinder": primitives.cylinder(0.4, 0.3),
    "rounded box": primitives.rounded(primitives.box(vector(0.3, 0.3, 0.2)), 0.1),
}
COMBINED = {
    "union": primitives.union(*EXACT.values()),
    "intersection": primitives.intersection(EXACT["sphere"], EXACT["box"]),
    "difference": primitives.difference(EXACT["box"], EXACT["sphere"], EXACT["capsule"]),
    "smooth union": primitives.smooth_union(EXACT["box"], EXACT["sphere"], 0.2),
}
ALL = {**EXACT, **COMBINED}
every_field = pytest.mark.parametrize("field", ALL.values(), ids=ALL)


def points(seed: int, count: int = 300) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=f64)


@pytest.mark.parametrize(
    ("field", "point", "value"),
    [
        (primitives.sphere(0.5), (0, 0.6, 0.8), 0.5),
        (EXACT["sphere"], (0.1, -0.2, 0.3), -0.5),
        (EXACT["plane"], (0, 0, 0), -0.2),
        (EXACT["plane"], (1, 2, -2), 3 - 0.2),
        (EXACT["box"], (0, 0, 0), -0.2),
        (EXACT["box"], (0.25, 0, 0), -0.05),
        (EXACT["box"], (1.3, 0.1, 0), 1),
        (EXACT["box"], (0.6, -0.9, 0.1), 0.5),
        (EXACT["box"], (0.4, 0.7, -0.4), 0.3),
        (EXACT["torus"], (0, 0, 0), 0.3),
        (EXACT["torus"], (0.3, 0, 0.4), -0.2),
        (EXACT["torus"], (0, 0.4, 0.8), 0.3),
        (primitives.capsule(vector(0, -0.5, 0), vector(0, 0.5, 0), 0.1), (0.3, 0.2, 0), 0.2),
        (primitives.capsule(vector(0, -0.5, 0), vector(0, 0.5, 0), 0.1), (0.3, 0.9, 0), 0.4),
        (EXACT["cylinder"], (0, 0, 0), -0.3),
        (EXACT["cylinder"], (0.6, 0.1, 0.8), 0.6),
        (EXACT["cylinder"], (0.7, -0.7, 0), 0.5),
        (EXACT["rounded box"], (0.3, 0.3, 1.3), 1),
        (primitives.union(primitives.sphere(0.5), primitives.sphere(0.1, vector(1, 0, 0))), (1, 0, 0), -0.1),
        (primitives.intersection(primitives.sphere(0.5), primitives.plane(vector(0, 1, 0))), (0, 0.2, 0), 0.2),
        (primitives.difference(primitives.sphere(0.5), primitives.sphere(0.3)), (0, 0, 0), 0.3),
        (primitives.difference(primitives.sphere(0.5), primitives.sphere(0.3)), (0, 0.4, 0), -0.1),
    ],
)
def test_values_are_the_closed_forms(field: SDF, point: tuple, value: float) -> None:
    assert field(vector(*point)[None]).item() == pytest.approx(value, abs=1e-12)


@every_field
@given(seed=st.integers(0, 10**6), scale=st.sampled_from([1e-3, 0.1, 1]))
def test_no_field_changes_faster_than_one_moves(field: SDF, seed: int, scale: float) -> None:
    here, there = points(seed), points(seed) + scale * points(seed + 1)
    assert ((field(there) - field(here)).abs() <= (there - here).norm(dim=-1) * (1 + 1e-9)).all()


@pytest.mark.parametrize("field", EXACT.values(), ids=EXACT)
@given(seed=st.integers(0, 10**6))
def test_from_outside_a_step_of_the_value_down_the_gradient_ends_on_the_surface(field: SDF, seed: int) -> None:
    p = points(seed)
    p = p[field(p) > 0]
    value, gradient = value_and_gradient(field, p)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones_like(value))
    torch.testing.assert_close(field(p - value[:, None] * gradient), torch.zeros_like(value), rtol=0, atol=1e-9)


@every_field
def test_gradients_are_finite_also_at_centres_axes_and_edges(field: SDF) -> None:
    grid = vector(-0.5, -0.3, -0.2, 0, 0.1, 0.2, 0.3, 0.4, 0.5)
    p = torch.cat([torch.cartesian_prod(grid, grid, grid), vector(0.1, -0.2, 0.3)[None]])
    value, gradient = value_and_gradient(field, p)
    assert value.isfinite().all()
    assert gradient.isfinite().all()
    assert gradient.norm(dim=-1).max() <= 1 + 1e-9


@pytest.mark.parametrize("make", [primitives.box, lambda size: primitives.cylinder(size[0], size[1])])
def test_the_normals_on_faces_edges_and_corners_have_finite_derivatives(make) -> None:
    """Where torch's own second derivative of the norm of a zero vector is NaN."""
    size = vector(0.3, 0.4, 0.5).requires_grad_()
    p = torch.tensor(
        [[0.3, 0, 0], [0, 0.4, 0], [0.3, 0.4, 0], [0.3, 0.4, 0.5], [0.1, 0.4, 0.2]], dtype=f64, requires_grad=True
    )
    _, gradient = value_and_gradient(make(size), p)
    derivatives = torch.autograd.grad(gradient.square().sum() + gradient.sum(), (p, size), allow_unused=True)
    assert all(d.isfinite().all() for d in derivatives if d is not None)


def test_the_norm_is_the_norm_and_has_no_slope_at_zero() -> None:
    v = torch.tensor([[3.0, 4.0], [0.0, 0.0], [0.0, -2.0]], dtype=f64, requires_grad=True)
    assert _length(v).tolist() == [5, 0, 2]
    (slope,) = torch.autograd.grad(_length(v).sum(), v)
    assert slope.tolist() == [[0.6, 0.8], [0, 0], [0, -1]]


def test_a_smooth_union_fills_the_crease_by_a_quarter_of_its_width_and_nothing_else() -> None:
    first, second = primitives.plane(vector(1, 0, 0)), primitives.plane(vector(0, 1, 0))
    smooth, sharp = primitives.smooth_union(first, second, 0.2), primitives.union(first, second)
    crease, beside = torch.zeros(1, 3, dtype=f64), vector(0.5, 0.25, 0)[None]
    assert (sharp(crease) - smooth(crease)).item() == pytest.approx(0.2 / 4)
    assert smooth(beside) == sharp(beside)


@every_field
def test_fields_take_points_of_any_batch(field: SDF) -> None:
    p = points(0, 24)
    torch.testing.assert_close(field(p.reshape(2, 3, 4, 3)), field(p).reshape(2, 3, 4))
    assert field(p[:0]).shape == (0,)


def test_sizes_may_require_grad() -> None:
    """A solid that grows comes nearer: by 1 for a radius, by the normal's part along an axis for an extent."""
    radius, size = torch.tensor(0.2, dtype=f64, requires_grad=True), vector(0.3, 0.5, 0.2).requires_grad_()
    p = vector(0.6, 0.9, 0.1)[None]
    (by_size,) = torch.autograd.grad(primitives.box(size)(p).sum(), size)
    assert by_size.tolist() == pytest.approx([-0.6, -0.8, 0])
    start, end = vector(0, 0, 0), vector(0, 1, 0)
    for field in (
        primitives.sphere(radius),
        primitives.torus(0.5, radius),
        primitives.capsule(start, end, radius),
        primitives.rounded(primitives.box(size.detach()), radius),
    ):
        (by_radius,) = torch.autograd.grad(field(p).sum(), radius)
        assert by_radius.item() == pytest.approx(-1)
    major = torch.tensor(0.5, dtype=f64, requires_grad=True)
    (by_major,) = torch.autograd.grad(primitives.torus(major, 0.2)(p).sum(), major)
    around = math.hypot(0.6, 0.1) - 0.5
    assert by_major.item() == pytest.approx(-around / math.hypot(around, 0.9))


@pytest.mark.parametrize(
    ("of_lists", "of_tensors"),
    [
        (primitives.sphere(0.5, (0.1, -0.2, 0.3)), EXACT["sphere"]),
        (primitives.plane([1, 2, -2], 0.2), EXACT["plane"]),
        (primitives.box([0.3, 0.5, 0.2]), EXACT["box"]),
        (primitives.capsule([-0.3, 0, 0.1], (0.4, 0.2, 0), 0.2), EXACT["capsule"]),
    ],
)
def test_vectors_may_be_lists(of_lists: SDF, of_tensors: SDF) -> None:
    points = torch.rand(20, 3, dtype=f64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(of_lists(points), of_tensors(points))
