"""The cells that may hold surface: none is excluded that does, and they serve other views."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from distrace.camera import Camera
from distrace.checkpoints.model import load_model
from distrace.fields import primitives
from distrace.fields.base import SDF, Counted
from distrace.rays import meet_sphere
from distrace.render import render
from distrace.tracing.bounds import Occupancy, find_occupancy
from distrace.tracing.evaluator import Evaluator
from distrace.tracing.tracer import TracerConfig

f64 = torch.float64
sphere = primitives.sphere(0.5)
BLOB = primitives.smooth_union(
    primitives.sphere(0.3, torch.tensor([0.2, 0.1, 0.0])), primitives.box(torch.tensor([0.5, 0.1, 0.2])), 0.2
)


def occupancy_of(sdf: SDF, lipschitz: float | None = None, radius: float = 1.0) -> Occupancy:
    return find_occupancy(Evaluator(sdf, radius), torch.zeros(1), lipschitz)


def before_their_neighbours(occupied: Tensor) -> Tensor:
    """Cells all of whose neighbours are occupied, as those of a cell that was not excluded are."""
    return -max_pool3d(-occupied[None, None].float(), 3, 1, 1)[0, 0] > 0


def view(size: int = 32, azimuth: float = 30.0, **more) -> Camera:
    return Camera.orbit(azimuth, 20, 4.97, height=size, width=size, **more)


def fields() -> list[SDF]:
    return [BLOB, load_model("sofas").field(0), load_model("chairs").field(3)]


@pytest.mark.parametrize("number", range(3), ids=["smooth union", "sofa", "chair"])
def test_no_excluded_cell_holds_a_change_of_sign(number: int) -> None:
    sdf = fields()[number]
    with torch.no_grad():
        occupancy = occupancy_of(sdf)
        cells = occupancy.occupied.shape[-1]
        kept = before_their_neighbours(occupancy.occupied[0])
        points = torch.rand(60_000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
        points = points[points.norm(dim=1) < 1]
        solid = points[sdf(points) <= 0]
        assert len(solid) > 200
        x, y, z = ((solid + 1) * (cells / 2)).long().unbind(1)
        assert kept[x, y, z].all()
    assert occupancy.occupied.float().mean() < 0.5, "most of the sphere is empty"


def test_the_cells_of_a_thin_plate_are_kept_all_along_it() -> None:
    plate = primitives.box(torch.tensor([0.6, 0.6, 0.001]))
    occupied = occupancy_of(plate).occupied[0]
    cells = occupied.shape[-1]
    points = torch.cartesian_prod(torch.linspace(-0.59, 0.59, 60), torch.linspace(-0.59, 0.59, 60), torch.zeros(1))
    x, y, z = ((points + 1) * (cells / 2)).long().unbind(1)
    assert before_their_neighbours(occupied)[x, y, z].all()


def test_a_given_lipschitz_constant_is_the_one_that_is_used() -> None:
    tight, loose = occupancy_of(sphere, 1.0), occupancy_of(sphere, 4.0)
    assert tight.lipschitz.tolist() == [1.0]
    assert loose.lipschitz.tolist() == [4.0]
    assert tight.occupied.sum() < loose.occupied.sum()
    rendered = render(sphere, view(16), config=TracerConfig(lipschitz=4.0))
    assert rendered.occupancy is not None
    assert rendered.occupancy.lipschitz.tolist() == [4.0]


@pytest.mark.parametrize("slope", [0.3, 1.0, 7.0])
def test_the_lipschitz_constant_is_measured(slope: float) -> None:
    measured = occupancy_of(lambda points: slope * sphere(points)).lipschitz.item()
    assert slope <= measured <= 1.3 * slope


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("inf"), float("nan")])
def test_a_lipschitz_constant_or_a_tolerance_that_bounds_nothing_is_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match=f"lipschitz={wrong}.*positive"):
        TracerConfig(lipschitz=wrong)
    with pytest.raises(ValueError, match=f"tolerance={wrong}.*positive"):
        TracerConfig(tolerance=wrong)


def test_the_occupancy_of_one_view_serves_another_and_saves_what_it_cost() -> None:
    occupancy = render(BLOB, view()).occupancy
    assert occupancy is not None
    counted = Counted(BLOB)
    alone = render(BLOB, view(azimuth=80.0))
    again = render(counted, view(azimuth=80.0), occupancy=occupancy)
    assert again.occupancy is occupancy
    assert (again.trace.outcome == alone.trace.outcome).all()
    torch.testing.assert_close(again.trace.distance, alone.trace.distance, rtol=0, atol=0)
    assert again.trace.total_evaluations == counted.evaluations
    assert alone.trace.total_evaluations - again.trace.total_evaluations > 4096


def test_an_occupancy_of_another_radius_or_number_of_shapes_is_refused() -> None:
    occupancy = occupancy_of(sphere)
    with pytest.raises(ValueError, match=r"radius of 1\.0 was given with 2\.0"):
        render(sphere, view(8), radius=2.0, occupancy=occupancy)
    model = load_model("sofas")
    both = model.field(model.codes[:2])
    cameras = Camera.orbit(torch.tensor([0.0, 30.0]), 20, 4.97, height=8, width=8)
    with pytest.raises(ValueError, match="occupancy of 1 shapes was given with a field of 2"):
        render(both, cameras, occupancy=occupancy)


def test_where_a_ray_is_lowest_is_near_its_least_value() -> None:
    """In a batch of two shapes, of each ray's own."""
    first, second = primitives.sphere(0.5), primitives.sphere(0.2, torch.tensor([0.3, -0.2, 0.1]))
    both = torch.cat([occupancy_of(sdf).values for sdf in (first, second)])
    occupancy = Occupancy(torch.ones(2, 32, 32, 32, dtype=torch.bool), torch.ones(2), both, 1.0)
    rays = view(24).rays().flat()
    rays = rays[meet_sphere(rays).meets]
    for shape, (sdf, centre) in enumerate(((first, torch.zeros(3)), (second, torch.tensor([0.3, -0.2, 0.1])))):
        bounds = meet_sphere(rays)
        t = occupancy.lowest(rays, bounds, torch.full((len(rays.directions),), shape))
        least = ((centre - rays.origins) * rays.directions).sum(-1).clamp(bounds.near, bounds.far)
        over = sdf(rays.at(t)) - sdf(rays.at(least))
        through = sdf(rays.at(least)) < 0.1
        assert over[~through].max() < 0.01
