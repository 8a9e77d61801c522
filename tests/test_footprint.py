"""Footprint normals: right on smooth fields, and with a derivative that a loss can use on networks of flat pieces."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from distrace import losses, surface
from distrace.boundary import shade
from distrace.camera import Camera
from distrace.checkpoints.model import load_model
from distrace.fields import primitives
from distrace.fields.base import SDF, Counted
from distrace.fields.decoder import Decoder
from distrace.render import FOOTPRINT, WIDEST, Buffers, render, render_rays
from distrace.tracing.sphere_tracing import DYNAMIC

f64 = torch.float64
LIGHT = normalize(torch.tensor([0.4, 0.8, 0.45]), dim=-1)


def view(size: int = 24, dtype: torch.dtype = f64) -> Camera:
    return Camera.orbit(30, 20, 4.97, height=size, width=size, dtype=dtype)


def on_sphere(count: int = 50) -> Tensor:
    return normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=f64), dim=-1) / 2


def lambert(points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    return (normals @ LIGHT.to(normals)).clamp_min(0)[:, None]


def test_on_a_sphere_they_are_its_normals_and_so_are_their_derivatives() -> None:
    centre = torch.tensor([0.1, 0.2, -0.1], dtype=f64, requires_grad=True)
    points = on_sphere().requires_grad_()
    width = torch.full((50,), 0.05, dtype=f64)
    random = torch.randn(50, 3, generator=torch.Generator().manual_seed(1), dtype=f64)
    found = surface.footprint_normals(primitives.sphere(0.5, centre), points, width)
    exact = normalize(points - centre, dim=-1)
    torch.testing.assert_close(found, exact, rtol=0, atol=1e-3)
    by_found = torch.autograd.grad((found * random).sum(), (centre, points))
    by_exact = torch.autograd.grad((exact * random).sum(), (centre, points))
    for slope, true in zip(by_found, by_exact, strict=True):
        torch.testing.assert_close(slope, true, rtol=0, atol=5e-3 * float(true.abs().max()))


def test_on_a_plane_they_are_exact_and_across_an_edge_they_lie_between_both_faces() -> None:
    normal = torch.tensor([0.6, 0.0, 0.8], dtype=f64)
    width = torch.full((1,), 0.04, dtype=f64)
    found = surface.footprint_normals(primitives.plane(normal), torch.zeros(1, 3, dtype=f64), width)
    torch.testing.assert_close(found, normal[None])
    box = primitives.box(torch.tensor([0.5, 0.5, 0.5], dtype=f64))
    for x, away in ((0.44, 0.0), (0.499, 1.0)):
        place = torch.tensor([[x, 0.0, 0.5]], dtype=f64)
        found = surface.footprint_normals(box, place, width)[0]
        assert (found[0] > 0.2) == (away > 0)
        assert found[2] > 0.5


def test_their_derivative_by_the_width_is_there() -> None:
    """A wider footprint reaches farther across an edge."""
    box, place = primitives.box(torch.tensor([0.5, 0.5, 0.5], dtype=f64)), torch.tensor([[0.49, 0.1, 0.5]], dtype=f64)
    width = torch.tensor([0.05], dtype=f64, requires_grad=True)
    (by_width,) = torch.autograd.grad(surface.footprint_normals(box, place, width)[0, 0], width)
    with torch.no_grad():
        wider, narrower = (surface.footprint_normals(box, place, width + h)[0, 0] for h in (1e-5, -1e-5))
    assert by_width.item() == pytest.approx(float(wider - narrower) / 2e-5, rel=1e-4)
    assert by_width.item() != 0


def test_directions_are_32_and_no_axis_is_preferred() -> None:
    taps = surface.directions_of_taps(torch.zeros((), dtype=f64))
    assert taps.shape == (32, 3)
    torch.testing.assert_close(taps.sum(0), torch.zeros(3, dtype=f64))
    torch.testing.assert_close(taps.T @ taps, 32 / 3 * torch.eye(3, dtype=f64))


def test_many_points_in_parts_have_the_gradient_of_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    width, slopes = torch.full((50,), 0.05, dtype=f64), []
    for part in (surface.GRAPH_POINTS, 100):
        monkeypatch.setattr(surface, "GRAPH_POINTS", part)
        centre = torch.tensor([0.1, 0.2, -0.1], dtype=f64, requires_grad=True)
        found = surface.footprint_normals(primitives.sphere(0.5, centre), on_sphere(), width)
        slopes += torch.autograd.grad(found[:, 0].square().sum(), centre)
    torch.testing.assert_close(*slopes)


@pytest.mark.parametrize("width", [0.0, -0.1, float("nan")])
def test_widths_that_are_none_are_refused(width: float) -> None:
    with pytest.raises(ValueError, match=f"a width of {width}"):
        surface.footprint_normals(primitives.sphere(0.5), on_sphere(), torch.full((50,), width, dtype=f64))


def test_the_image_is_zero_on_the_background_and_made_once() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    buffers = render(primitives.sphere(radius), view())
    assert (buffers.footprint_normal[~buffers.mask] == 0).all()
    torch.testing.assert_close(buffers.footprint_normal[buffers.mask], buffers.normal[buffers.mask], rtol=0, atol=5e-3)
    assert buffers.footprint_normal is buffers.footprint_normal
    assert buffers.footprint_normal.requires_grad
    with torch.no_grad():
        assert not buffers.footprint_normal.requires_grad
    away = render(primitives.sphere(0.2, torch.tensor([0, 9.0, 0], dtype=f64)), view())
    assert (away.footprint_normal == 0).all()


def test_footprints_are_some_pixels_wide_and_in_coarse_images_a_part_of_the_radius() -> None:
    for size, width in ((24, WIDEST), (960, FOOTPRINT * 4.47 / (960 * 60 / 32))):
        camera = view(size)
        buffers = render_rays(primitives.sphere(0.5), camera, torch.full((1, 2), size / 2, dtype=f64), config=DYNAMIC)
        assert buffers.footprint_widths.item() == pytest.approx(width, rel=1e-3)


def test_cameras_in_a_batch_have_the_footprints_of_each() -> None:
    box, cameras = primitives.box(torch.tensor([0.5, 0.3, 0.4], dtype=f64)), [view(40), view(40).turned(50)]
    matrices = (torch.stack([getattr(c, name) for c in cameras]) for name in ("intrinsics", "T_world_camera"))
    together = render(box, Camera.from_matrices(*matrices, 40, 40)).footprint_normal
    for k, camera in enumerate(cameras):
        torch.testing.assert_close(together[k], render(box, camera).footprint_normal, rtol=0, atol=1e-9)


def test_one_more_image_costs_32_evaluations_a_hit() -> None:
    counted = Counted(primitives.sphere(0.5))
    buffers = render(counted, view())
    assert buffers.points.any()
    before = counted.evaluations
    assert buffers.footprint_normal.any()
    assert counted.evaluations - before == 32 * int(buffers.mask.sum()) + 1, "one tells whether the field has a graph"


@pytest.fixture(scope="module")
def decoder() -> tuple[Decoder, Tensor]:
    model = load_model("sofas")
    return model.decoder, model.codes[3]


def seen(decoder: Decoder, code: Tensor, size: int = 20) -> Buffers:
    return render(decoder.field(code), view(size, torch.float32))


def test_a_loss_on_a_decoders_normals_falls_along_its_gradient(decoder: tuple[Decoder, Tensor]) -> None:
    """That of the exact normals is nothing."""
    network, start = decoder
    with torch.no_grad():
        observed = seen(network, load_model("sofas").codes[10]).normal
    code = start.clone().requires_grad_()
    buffers = seen(network, code)
    loss = losses.normal_loss(buffers, observed)
    (slope,) = torch.autograd.grad(loss, code, retain_graph=True)
    both = buffers.mask & observed.any(-1)
    exact = 1 - (buffers.normal[both] * observed[both]).sum(-1).mean()
    (nothing,) = torch.autograd.grad(exact, code)
    assert nothing.norm() < 1e-4 * slope.norm()
    step = 0.1 * loss.item() / slope.norm().square()
    with torch.no_grad():
        after = losses.normal_loss(seen(network, code - step * slope), observed)
    assert after < 0.97 * loss.item(), "a tenth of it, to first order"


@pytest.mark.slow
def test_shading_a_decoder_keeps_exact_values_and_its_gradient_follows_differences() -> None:
    """Outlines and exact normals alone give a slope of the other sign here."""
    model = load_model("chairs")
    start, along = model.codes[200], model.codes[11] - model.codes[200]

    def mean(h: Tensor, size: int) -> Tensor:
        camera = Camera.orbit(30, 20, 2.6, height=size, width=size, focal_mm=30)
        buffers = render(model.field(start + h * along), camera)
        image = shade(buffers, lambert, torch.zeros(1))
        lit = (buffers.normal[buffers.mask] @ LIGHT).clamp_min(0)
        assert torch.equal(image[buffers.mask][:, 0], lit)
        across = torch.linspace(0, 1, size)
        return (image[..., 0] * (3 * across[None] ** 2 + 0.7 * across[:, None])).mean()

    h = torch.zeros((), requires_grad=True)
    (slope,) = torch.autograd.grad(mean(h, 64), h)
    with torch.no_grad():
        before, after = (mean(torch.tensor(step), 320) for step in (-0.05, 0.05))
    assert slope.item() == pytest.approx(float(after - before) / 0.1, rel=0.3)


def test_colours_without_normals_and_smooth_fields_do_not_pay_for_footprints(
    decoder: tuple[Decoder, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(sdf: SDF, points: Tensor, width: Tensor) -> Tensor:
        raise AssertionError("footprint normals were made")

    monkeypatch.setattr(surface, "footprint_normals", refused)
    network, start = decoder
    white = lambda points, normals, directions: torch.ones_like(points[:, :1])  # noqa: E731
    assert shade(seen(network, start.clone().requires_grad_()), white, torch.zeros(1)).any()
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    assert shade(render(primitives.sphere(radius), view()), lambert, torch.zeros(1, dtype=f64)).requires_grad
    with pytest.raises(AssertionError, match="footprint normals were made"):
        shade(seen(network, start.clone().requires_grad_()), lambert, torch.zeros(1))


def test_a_second_backward_pass_of_one_rendering_says_what_to_do(decoder: tuple[Decoder, Tensor]) -> None:
    network, start = decoder
    for image in ("depth", "normal", "points", "footprint_normal"):
        code = start.clone().requires_grad_()
        buffers = seen(network, code, 12)
        buffers.depth[buffers.mask].sum().backward()
        with pytest.raises(RuntimeError, match="add up the losses"):
            getattr(buffers, image)[0].sum().backward()


def test_with_a_kept_graph_or_as_a_sum_two_losses_have_both_gradients() -> None:
    slopes = []
    for together in (True, False):
        radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
        buffers = render(primitives.sphere(radius), view())
        terms = buffers.depth[buffers.mask].sum(), buffers.points.square().sum()
        if together:
            sum(terms).backward()
        else:
            terms[0].backward(retain_graph=True)
            terms[1].backward()
        slopes.append(radius.grad)
    torch.testing.assert_close(*slopes)


def test_footprints_of_a_batch_of_orbits_have_the_angles_derivatives() -> None:
    def middles(azimuth: Tensor) -> Tensor:
        camera = Camera.orbit(azimuth, 20, 4.97, height=24, width=24)
        return render(ellipsoid, camera, config=DYNAMIC).footprint_normal[:, 12, 12, 0]

    def ellipsoid(points: Tensor) -> Tensor:
        return 0.3 * (points / points.new_tensor([0.6, 0.4, 0.3])).norm(dim=-1) - 0.3

    azimuth = torch.tensor([10.0, 100.0], dtype=f64, requires_grad=True)
    (slope,) = torch.autograd.grad(middles(azimuth).sum(), azimuth)
    with torch.no_grad():
        difference = (middles(azimuth + 0.01) - middles(azimuth - 0.01)) / 0.02
    torch.testing.assert_close(slope, difference, rtol=1e-2, atol=1e-5)
    assert (slope.abs() > 1e-3).all()
