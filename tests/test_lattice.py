"""The lattice: the field at its corners, trilinear between them, and honest about how far off that is."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import normalize

from distrace import primitives
from distrace.fast.lattice import Lattice, LatticeConfig, build
from distrace.field import SDF, Counted
from distrace.steepness import typical_slope

f64 = torch.float64
CONFIG, DOUBLE = LatticeConfig(), torch.empty(0, dtype=f64)
EXTENTS = torch.tensor([0.5, 0.3, 0.4], dtype=f64)
FAR = primitives.sphere(0.5, torch.tensor([0, 9.0, 0], dtype=f64))


def lattice_of(sdf: SDF, config: LatticeConfig = CONFIG) -> Lattice:
    return build(sdf, config, DOUBLE)


def corners(lattice: Lattice) -> torch.Tensor:
    along = torch.linspace(-1, 1, len(lattice.values), dtype=f64)
    return torch.stack(torch.meshgrid(along, along, along, indexing="ij"), dim=-1)


def random_points(count: int, reach: float, seed: int = 0) -> torch.Tensor:
    """Within a ball."""
    points = torch.rand(2 * count + 100, 3, generator=torch.Generator().manual_seed(seed), dtype=f64) * 2 - 1
    return reach * points[points.norm(dim=-1) < 1][:count]


def on_sphere(radius: float) -> torch.Tensor:
    return radius * normalize(random_points(3000, 1.0), dim=-1)


def on_torus(major: float, minor: float) -> torch.Tensor:
    around, across = 7 * random_points(3000, 1.0)[:, :2].T
    from_axis = major + minor * across.cos()
    return torch.stack([from_axis * around.cos(), minor * across.sin(), from_axis * around.sin()], dim=-1)


def on_box(half_extents: torch.Tensor) -> torch.Tensor:
    points = random_points(3000, 1.0).clamp(-0.99, 0.99)
    points = points / points.abs().amax(-1, keepdim=True) * half_extents
    return points[points.abs().amax(-1) > 0.1]


SURFACES = {
    "sphere": (primitives.sphere(0.7), on_sphere(0.7)),
    "small sphere": (primitives.sphere(0.15), on_sphere(0.15)),
    "torus": (primitives.torus(0.6, 0.2), on_torus(0.6, 0.2)),
    "thin torus": (primitives.torus(0.6, 0.05), on_torus(0.6, 0.05)),
    "box": (primitives.box(EXTENTS), on_box(EXTENTS)),
}
every_surface = pytest.mark.parametrize(("sdf", "surface"), SURFACES.values(), ids=SURFACES)
every_smooth_surface = pytest.mark.parametrize(
    ("sdf", "surface"), list(SURFACES.values())[:-1], ids=list(SURFACES)[:-1]
)


class Watched:
    """A field that remembers where it was asked."""

    def __init__(self, sdf: SDF) -> None:
        self.sdf, self.asked = sdf, []

    def __call__(self, points: torch.Tensor) -> torch.Tensor:
        self.asked.append(points)
        return self.sdf(points)


class Narrowing(Watched):
    """A field with a cheaper form of itself, which is another object."""

    def __init__(self, sdf: SDF) -> None:
        super().__init__(sdf)
        self.near, self.narrowed_at = Watched(sdf), []

    def narrowed(self, points: torch.Tensor) -> tuple[torch.Tensor, SDF]:
        self.narrowed_at.append(points)
        return self.sdf(points), self.near


def trilinear(points: torch.Tensor) -> torch.Tensor:
    x, y, z = points.unbind(-1)
    return 0.05 + 0.3 * x - 0.5 * y * z + 0.4 * x * y * z


@every_surface
def test_at_corners_by_the_surface_the_value_is_the_fields(sdf: SDF, surface: torch.Tensor) -> None:
    lattice = lattice_of(sdf)
    true = sdf(corners(lattice))
    by_surface = true.abs() < lattice.cell / 2
    assert by_surface.any()
    torch.testing.assert_close(lattice.values[by_surface], true[by_surface], rtol=0, atol=1e-12)
    asked = corners(lattice)[by_surface]
    torch.testing.assert_close(lattice(asked)[0], true[by_surface], rtol=0, atol=1e-12)


def test_value_and_slack_are_trilinear_between_corners() -> None:
    lattice = lattice_of(primitives.sphere(0.6))
    points = random_points(50, 0.9)
    low = ((points + 1) / lattice.cell).floor().long()
    part = (points + 1) / lattice.cell - low
    expected = torch.zeros(2, 50, dtype=f64)
    for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
        weight = torch.where(corner.bool(), part, 1 - part).prod(-1)
        at = (low + corner).unbind(-1)
        expected += weight * torch.stack([lattice.values[at], lattice.slack[at]])
    torch.testing.assert_close(torch.stack(lattice(points)), expected, rtol=0, atol=1e-12)


def test_a_trilinear_field_is_known_exactly_and_without_doubt() -> None:
    lattice, points = lattice_of(trilinear), random_points(500, 0.55)
    value, slack = lattice(points)
    torch.testing.assert_close(value, trilinear(points), rtol=0, atol=1e-12)
    by_surface = trilinear(points).abs() < 0.1 * lattice.cell
    assert by_surface.any()
    assert slack[by_surface].max() < 1e-12


@given(seed=st.integers(0, 1000))
def test_the_slope_of_a_linear_field_is_that_of_the_field(seed: int) -> None:
    normal, direction = normalize(random_points(2, 1.0, seed), dim=-1)
    lattice, points = lattice_of(primitives.plane(normal)), random_points(20, 0.5, seed)
    expected = (normal @ direction).expand(20)
    torch.testing.assert_close(lattice.slope(points, direction.expand(20, 3)), expected, rtol=0, atol=1e-9)


@every_smooth_surface
def test_a_smooth_surface_is_only_where_the_value_is_below_the_slack(sdf: SDF, surface: torch.Tensor) -> None:
    value, slack = lattice_of(sdf)(surface)
    assert sdf(surface).abs().max() < 1e-12
    assert (value < slack).all()


def test_by_the_edges_of_a_box_few_points_are_farther_off_than_the_slack_has_it() -> None:
    """Half of the last error covers a kink in the middle of a cell, not one that lies anywhere."""
    sdf, surface = SURFACES["box"]
    lattice = lattice_of(sdf)
    value, slack = lattice(surface)
    beyond = value - slack > 1e-9
    assert 0 < beyond.double().mean() < 0.02
    from_edge = (EXTENTS - surface.abs()).sort(-1).values[:, 1]
    assert from_edge[beyond].max() < lattice.cell


@every_smooth_surface
def test_the_slack_bounds_the_error_near_a_smooth_surface(sdf: SDF, surface: torch.Tensor) -> None:
    lattice = lattice_of(sdf)
    points = surface + random_points(len(surface), lattice.cell / 4, seed=1)
    value, slack = lattice(points)
    assert ((value - sdf(points)).abs() <= slack).double().mean() > 0.97


def test_the_slack_by_the_surface_shrinks_by_four_with_each_level() -> None:
    """A smooth field's error goes with the square of the cell's width."""
    sdf, surface = SURFACES["sphere"]
    means = [lattice_of(sdf, LatticeConfig(levels=levels))(surface)[1].mean() for levels in (2, 3, 4)]
    ratios = [float(first / second) for first, second in pairwise(means)]
    assert min(ratios) > 3
    assert max(ratios) < 7


@every_surface
def test_the_field_is_asked_as_often_as_is_counted(sdf: SDF, surface: torch.Tensor) -> None:
    counted = Counted(sdf)
    assert lattice_of(counted).evaluations == counted.evaluations < 0.4 * 29**3


@pytest.mark.parametrize("cells", [2, 5, 7])
@pytest.mark.parametrize("levels", [1, 2, 4])
def test_no_point_is_asked_far_outside_of_the_sphere(cells: int, levels: int) -> None:
    watched = Watched(primitives.plane(torch.tensor([0.2, 1.0, 0.3], dtype=f64)))
    lattice_of(watched, LatticeConfig(cells, levels))
    assert torch.cat(watched.asked).norm(dim=-1).max() <= 1 + 1 / cells


def test_no_corner_is_asked_twice() -> None:
    watched = Watched(primitives.torus(0.6, 0.2))
    lattice = lattice_of(watched)
    asked = torch.cat(watched.asked)
    indices = ((asked + 1) / lattice.cell).round().long()
    torch.testing.assert_close(indices.double() * lattice.cell - 1, asked, rtol=0, atol=1e-12)
    assert len(indices.unique(dim=0)) == len(asked)


def test_finer_corners_are_asked_by_the_surface_alone() -> None:
    """Within the cells that can hold it: their diagonal away, and as much as the slack has it."""
    watched = Watched(primitives.sphere(0.6))
    lattice_of(watched)
    assert len(watched.asked) == 3
    for points, cell in zip(watched.asked[1:], (2 / 7, 2 / 14)):
        assert 0 < watched.sdf(points).abs().max() < 1.2 * 3**0.5 * cell


def test_a_field_without_a_zero_is_asked_at_the_first_corners_alone() -> None:
    watched = Watched(FAR)
    lattice = lattice_of(watched)
    inside = int((corners(lattice)[::4, ::4, ::4].norm(dim=-1) <= 1 + 1 / 7).sum())
    assert lattice.evaluations == sum(len(points) for points in watched.asked) == inside


@every_surface
def test_the_box_holds_the_surface_and_little_more(sdf: SDF, surface: torch.Tensor) -> None:
    lattice = lattice_of(sdf)
    low, high = lattice.box()
    assert (surface >= low).all()
    assert (surface <= high).all()
    assert (surface.amin(0) - low).max() < 2 * lattice.cell + 0.02
    assert (high - surface.amax(0)).max() < 2 * lattice.cell + 0.02


@pytest.mark.parametrize("sdf", [FAR, lambda points: points.square().sum(-1) + 0.05], ids=["far", "but nearly"])
def test_a_field_without_a_zero_has_no_box(sdf: SDF) -> None:
    assert lattice_of(sdf).box() is None


def test_the_box_of_a_field_that_is_solid_everywhere_holds_the_sphere() -> None:
    low, high = lattice_of(primitives.sphere(3.0)).box()
    assert (low <= -1).all()
    assert (high >= 1).all()


@pytest.mark.parametrize("cells", [4, 7])
@pytest.mark.parametrize("levels", [1, 2, 3])
def test_cells_and_levels_are_those_of_the_configuration(cells: int, levels: int) -> None:
    lattice = lattice_of(primitives.sphere(0.5), LatticeConfig(cells, levels))
    assert lattice.values.shape == lattice.slack.shape == (cells * 2 ** (levels - 1) + 1,) * 3
    assert lattice.cell == pytest.approx(2 / (cells * 2 ** (levels - 1)))


@pytest.mark.parametrize("wrong", [dict(cells=1), dict(levels=0), dict(steepest=0.0), dict(steepest=float("nan"))])
def test_a_configuration_of_no_lattice_is_refused(wrong: dict) -> None:
    name, value = next(iter(wrong.items()))
    with pytest.raises(ValueError, match=f"{name}={value}.*is no lattice"):
        LatticeConfig(**wrong)


@pytest.mark.parametrize("dtype", [torch.float32, f64])
def test_the_precision_is_that_of_what_it_is_to_be_like(dtype: torch.dtype) -> None:
    watched = Watched(primitives.sphere(0.5))
    lattice = build(watched, CONFIG, torch.empty(0, dtype=dtype))
    assert {points.dtype for points in watched.asked} == {dtype}
    assert {image.dtype for image in (lattice.values, lattice.slack, *lattice.box())} == {dtype}
    assert {image.dtype for image in lattice(torch.zeros(4, 3, dtype=dtype))} == {dtype}


def test_a_field_of_nothing_but_nan_leaves_nan_and_is_asked_no_more_than_others() -> None:
    counted = Counted(lambda points: torch.full_like(points[..., 0], torch.nan))
    lattice = lattice_of(counted)
    assert lattice.values.isnan().any()
    assert lattice.evaluations == counted.evaluations <= 29**3


def test_nan_by_the_surface_stays_nan() -> None:
    whole = primitives.sphere(0.5)
    half = lattice_of(lambda points: whole(points).masked_fill(points[..., 0] > 0, torch.nan))
    assert half.values.isnan().any()


def test_nan_far_from_the_surface_is_filled() -> None:
    """A field need not be known outside of the unit sphere."""
    sdf, surface = primitives.sphere(0.2), on_sphere(0.2)
    whole = lattice_of(sdf)
    part = lattice_of(lambda points: sdf(points).masked_fill(points.norm(dim=-1) > 1, torch.nan))
    assert part.values.isfinite().all()
    torch.testing.assert_close(part(surface), whole(surface), rtol=0, atol=1e-12)
    assert (part(normalize(surface, dim=-1))[0] > 0.3).all()


def test_the_finest_level_alone_narrows_the_field() -> None:
    field = Narrowing(primitives.sphere(0.5))
    lattice = lattice_of(field)
    assert [len(field.asked), len(field.narrowed_at), len(field.near.asked)] == [2, 1, 0]
    assert len(torch.cat([*field.asked, *field.narrowed_at])) == lattice.evaluations
    plain = Watched(field.sdf)
    lattice_of(plain)
    assert torch.equal(field.narrowed_at[0], plain.asked[-1])
    assert lattice.field is field
    assert lattice.near is field.near


def test_a_single_level_narrows_nothing() -> None:
    field = Narrowing(primitives.sphere(0.5))
    lattice = lattice_of(field, LatticeConfig(levels=1))
    assert not field.narrowed_at
    assert lattice.near is lattice.field is field


def test_a_narrowed_field_leaves_the_lattice_as_it_would_be() -> None:
    plain, narrowing = lattice_of(primitives.sphere(0.5)), lattice_of(Narrowing(primitives.sphere(0.5)))
    torch.testing.assert_close(narrowing.values, plain.values, rtol=0, atol=0)
    torch.testing.assert_close(narrowing.slack, plain.slack, rtol=0, atol=0)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0, 3.0])
def test_the_steepness_of_a_box_is_what_its_distance_is_multiplied_by(factor: float) -> None:
    lattice = lattice_of(lambda points: factor * SURFACES["box"][0](points))
    assert lattice.measured_steepness() == pytest.approx(factor, rel=0.1)


def test_the_steepness_of_a_distance_is_one() -> None:
    assert lattice_of(primitives.sphere(0.6)).measured_steepness() == pytest.approx(1, abs=0.03)


def test_a_field_without_a_surface_has_no_steepness() -> None:
    assert lattice_of(FAR).measured_steepness() is None
    assert typical_slope(FAR, torch.empty(0, dtype=f64))[0] == 0


@pytest.mark.parametrize("factor", [0.1, 1.0, 20.0])
def test_a_typical_slope_is_taken_where_the_field_says_that_it_is_near(factor: float) -> None:
    slope, evaluations = typical_slope(lambda points: factor * (points.norm(dim=-1) - 1.0), torch.empty(0), radius=2.0)
    assert slope == pytest.approx(factor, rel=0.01)
    assert evaluations < 1500
