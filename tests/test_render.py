"""The whole way, from a field and a camera to images and back."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion
from torch import Tensor

from distrace.camera import Camera
from distrace.checkpoints.model import load_model
from distrace.fields import primitives
from distrace.fields.base import check_field
from distrace.rays import meet_sphere
from distrace.render import STRATEGIES, Buffers, Config, render, render_rays
from distrace.tracing.sphere_tracing import COARSE_TO_FINE, DYNAMIC, Outcome, TraceConfig
from distrace.tracing.tracer import TracerConfig

f64 = torch.float64
EXACT = replace(DYNAMIC, steps=500, tolerance=1e-9)
BUFFERS = ("distance", "depth", "points", "normal", "clearance")
every_strategy = pytest.mark.parametrize("config", STRATEGIES.values(), ids=STRATEGIES)


def view(size: int = 24, azimuth: float = 30, dtype: torch.dtype = f64) -> Camera:
    return Camera.orbit(azimuth, 20, 4.97, height=size, width=size, dtype=dtype)


def away() -> Camera:
    return Camera.look_at(torch.tensor([0, 0, 5.0], dtype=f64), torch.tensor([0, 0, 9.0], dtype=f64), height=8, width=8)


def seen(buffers: Buffers) -> Tensor:
    """A loss that uses everything that one may."""
    depth = buffers.depth.masked_fill(~buffers.mask, 0).square().sum()
    clearance = buffers.clearance[buffers.clearance.isfinite()].square().sum()
    return depth + buffers.normal[..., :2].sum() + buffers.points.sum() + clearance


def exactly(config: Config) -> Config:
    if isinstance(config, TracerConfig):
        return replace(config, tolerance=1e-9)
    return replace(config, tolerance=1e-9, steps=300)


@every_strategy
def test_the_images_of_a_sphere_are_its_closed_forms(config: Config) -> None:
    camera, radius = view(32), 0.5
    buffers = render(primitives.sphere(radius), camera, config=exactly(config))
    true = meet_sphere(camera.rays(), radius)
    assert buffers.mask.any()
    assert not (buffers.mask & ~true.meets).any()
    assert (buffers.mask != true.meets).sum() <= (2 if config is COARSE_TO_FINE else 0)  # by the outline
    expected = torch.where(buffers.mask, true.near, torch.inf)
    torch.testing.assert_close(buffers.distance, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(buffers.depth, expected * camera.cosines(), rtol=0, atol=1e-6)
    points = camera.rays()[buffers.mask].at(true.near[buffers.mask])
    torch.testing.assert_close(buffers.points, points, rtol=0, atol=1e-6)
    torch.testing.assert_close(buffers.normal[buffers.mask], points / radius, rtol=0, atol=1e-5)
    assert (buffers.normal[~buffers.mask] == 0).all()


def test_background_is_inf_and_depth_is_z() -> None:
    buffers = render(
        primitives.plane(torch.tensor([0, 0, 1.0], dtype=f64)), Camera.orbit(0, 0, 4, dtype=f64, height=9, width=9)
    )
    assert buffers.mask.any()
    assert (buffers.depth[~buffers.mask] == torch.inf).all()
    assert (buffers.distance[~buffers.mask] == torch.inf).all()
    torch.testing.assert_close(
        buffers.depth[buffers.mask], torch.full_like(buffers.points[:, 0], 4.0), rtol=0, atol=1e-6
    )


@every_strategy
def test_clearance_is_the_least_value_on_every_ray_that_misses(config: Config) -> None:
    """Also where a coarse ray has marched past it: it was off by 0.06 there.

    Where the default tracer has excluded a ray with its cells it is a value on the ray, near the least.
    """
    camera = view(32)
    buffers = render(primitives.sphere(0.3), camera, config=config)
    rays = camera.rays()
    true = torch.linalg.cross(rays.origins, rays.directions).norm(dim=-1) - 0.3
    meets = meet_sphere(rays).meets
    assert (buffers.clearance[~meets] == torch.inf).all()
    missed = meets & ~buffers.mask
    excluded = missed & (buffers.trace.evaluations == 0)
    assert (missed & ~excluded).sum() > 20
    torch.testing.assert_close(buffers.clearance[missed & ~excluded], true[missed & ~excluded], rtol=0, atol=1e-6)
    over = (buffers.clearance - true)[excluded]
    assert ((over > -1e-9) & (over < 0.01)).all()
    assert buffers.clearance[buffers.mask].abs().max() < 5e-5


@every_strategy
def test_a_view_of_nothing_has_every_buffer_and_every_gradient(config: Config) -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    nowhere = primitives.sphere(radius, torch.tensor([0, 9.0, 0], dtype=f64))
    for sdf, camera in ((primitives.sphere(radius), away()), (nowhere, view(8))):
        buffers = render(sdf, camera, config=config)
        assert not buffers.mask.any()
        assert (buffers.depth == torch.inf).all()
        assert (buffers.normal == 0).all()
        assert buffers.points.shape == (0, 3)
        for name in ("depth", "normal", "points"):
            image = getattr(buffers, name)
            (by_radius,) = torch.autograd.grad(image.where(image.isfinite(), 0.0).sum(), radius, retain_graph=True)
            assert by_radius == 0
        (by_radius,) = torch.autograd.grad(seen(buffers), radius)
        assert by_radius.isfinite()
        with torch.no_grad():
            assert [getattr(render(sdf, camera, config=config), name).requires_grad for name in BUFFERS] == [False] * 5


@every_strategy
@pytest.mark.parametrize("sdf", [primitives.sphere(0.5), primitives.box(torch.tensor([0.4, 0.5, 0.3], dtype=f64))])
def test_gradients_hold_no_nan_when_part_of_the_image_is_background(config: Config, sdf) -> None:
    start = view(16)
    camera = replace(
        start,
        intrinsics=start.intrinsics.clone().requires_grad_(),
        T_world_camera=start.T_world_camera.clone().requires_grad_(),
    )
    scale = torch.tensor(1.0, dtype=f64, requires_grad=True)
    buffers = render(lambda points: scale * sdf(points / scale), camera, config=config)
    assert buffers.mask.any()
    assert not buffers.mask.all()
    seen(buffers).backward()
    for parameter in (camera.intrinsics, camera.T_world_camera, scale):
        assert parameter.grad.isfinite().all()
        assert parameter.grad.any()


def test_a_box_seen_face_on_has_finite_gradients_of_its_normals() -> None:
    """Rays end exactly on the face, where a norm of zero is differentiated twice."""
    size = torch.tensor([0.25, 0.25, 0.5], requires_grad=True)
    buffers = render(primitives.box(size), Camera.orbit(0, 0, 4, height=8, width=8, focal_px=40))
    assert (buffers.points[:, 2] == 0.5).any()
    (by_size,) = torch.autograd.grad(buffers.normal.sum() + buffers.depth[buffers.mask].sum(), size)
    assert by_size.isfinite().all()
    assert by_size[2].item() == pytest.approx(-buffers.mask.sum().item(), rel=1e-3)


def test_the_gradients_of_images_are_those_of_their_closed_forms() -> None:
    """To the focal length and the radius at once; the normal's, through the point, too."""
    camera = view(16)
    focal = torch.tensor(camera.intrinsics[0, 0].item(), dtype=f64, requires_grad=True)
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    intrinsics = torch.diag(torch.stack([focal, focal, torch.ones_like(focal)]))
    intrinsics = intrinsics + camera.intrinsics * torch.tensor([[0, 0, 1.0], [0, 0, 1], [0, 0, 0]])
    zoomed = replace(camera, intrinsics=intrinsics)
    buffers = render(primitives.sphere(radius), zoomed, config=EXACT)
    hit, missed = buffers.mask, ~buffers.mask & meet_sphere(zoomed.rays().detach()).meets
    rays = zoomed.rays()
    b = (rays.origins * rays.directions).sum(-1)
    true = -b[hit] - (b[hit] ** 2 - 4.97**2 + radius**2).sqrt()
    passes = torch.linalg.cross(rays.origins, rays.directions)[missed].norm(dim=-1)
    right = camera.T_world_camera[:3, 0]  # in the mean a normal's part that way is zero, but not its size
    for image, exact in (
        (buffers.depth[hit], true * zoomed.cosines()[hit]),
        (buffers.points, rays[hit].at(true)),
        ((buffers.normal[hit] @ right).abs(), (rays[hit].at(true) @ right / radius).abs()),
        (buffers.clearance[missed], passes - radius),
    ):
        torch.testing.assert_close(image, exact, rtol=0, atol=1e-6)
        found = torch.autograd.grad(image.mean(), (focal, radius), retain_graph=True)
        expected = torch.autograd.grad(exact.mean(), (focal, radius), retain_graph=True)
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-9)


@every_strategy
def test_cameras_in_a_batch_see_what_each_sees_alone(config: Config) -> None:
    cameras = [view(12, azimuth) for azimuth in (0, 50, 200)]
    box = primitives.box(torch.tensor([0.5, 0.3, 0.2], dtype=f64))
    batch = Camera.from_matrices(
        torch.stack([c.intrinsics for c in cameras]), torch.stack([c.T_world_camera for c in cameras]), 12, 12
    )
    together = render(box, batch, config=config)
    assert together.mask.shape == (3, 12, 12)
    for k, camera in enumerate(cameras):
        alone = render(box, camera, config=config)
        assert alone.mask.any()
        assert (together.trace.outcome[k] == alone.trace.outcome).all()
        for name in ("distance", "depth", "normal", "clearance"):
            torch.testing.assert_close(getattr(together, name)[k], getattr(alone, name), rtol=0, atol=1e-9)


def test_rays_of_some_pixels_see_what_the_image_sees_there() -> None:
    camera = view(16)
    sdf = primitives.sphere(0.5)
    image = render(sdf, camera, config=DYNAMIC)
    chosen = camera.pixels().reshape(-1, 2)[::5]
    some = render_rays(sdf, camera, chosen, config=DYNAMIC)
    assert some.mask.any()
    for name in ("depth", "mask", "clearance"):
        torch.testing.assert_close(getattr(some, name), getattr(image, name).flatten()[::5], rtol=0, atol=1e-12)


def test_a_larger_radius_sees_a_larger_scene() -> None:
    large, camera = primitives.sphere(1.5), Camera.orbit(0, 0, 8, height=8, width=8, focal_px=40, dtype=f64)
    cut = render(large, camera)
    assert cut.trace.outcome[4, 4] == Outcome.INSIDE  # where the ray enters the unit sphere
    whole = render(large, camera, radius=2.0)
    true = meet_sphere(camera.rays(), 1.5)
    assert (whole.mask == true.meets).all()
    torch.testing.assert_close(whole.trace.distance[whole.mask], true.near[whole.mask], rtol=0, atol=1e-4)


def test_where_nothing_requires_grad_the_images_are_plain_numbers() -> None:
    buffers = render(primitives.sphere(0.5), view(8))
    assert [getattr(buffers, name).requires_grad for name in BUFFERS] == [False] * 5
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    buffers = render(primitives.sphere(radius), view(8))
    assert [getattr(buffers, name).requires_grad for name in BUFFERS] == [True] * 5


def test_the_preview_has_the_same_values() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    with_graph = render(primitives.sphere(radius), view(12))
    with torch.no_grad():
        preview = render(primitives.sphere(radius), view(12))
        images = {name: getattr(preview, name) for name in BUFFERS}
    for name, image in images.items():
        torch.testing.assert_close(image, getattr(with_graph, name).detach(), rtol=0, atol=0)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan")])
def test_a_radius_that_holds_nothing_is_refused(radius: float) -> None:
    with pytest.raises(ValueError, match=f"radius of {radius}"):
        render(primitives.sphere(0.5), view(4), radius=radius)


def test_what_was_first_read_without_gradients_has_them_later() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    buffers = render(primitives.sphere(radius), view(8))
    with torch.no_grad():
        plain = {name: getattr(buffers, name) for name in BUFFERS}
    assert not any(image.requires_grad for image in plain.values())
    for name, image in plain.items():
        assert getattr(buffers, name).requires_grad
        assert getattr(buffers, name) is getattr(buffers, name), "made once"
        torch.testing.assert_close(getattr(buffers, name).detach(), image, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("recorded", [False, True], ids=["constant", "recorded"])
def test_a_model_gives_the_same_images_under_autocast(dtype: torch.dtype, recorded: bool) -> None:
    model = load_model("sofas")
    code = model.codes[0].clone().requires_grad_(recorded)
    expected = images(render(model.field(code), view(16, dtype=torch.float32)))
    with torch.autocast("cpu", dtype):
        torch.testing.assert_close(images(render(model.field(code), view(16, dtype=torch.float32))), expected)


def images(buffers: Buffers) -> dict[str, Tensor]:
    return {name: getattr(buffers, name).detach() for name in (*BUFFERS, "footprint_normal")}


def test_a_normal_under_inference_mode_is_refused_by_that_name() -> None:
    with torch.inference_mode():
        buffers = render(primitives.sphere(0.5), view())
        assert buffers.depth.isfinite().any()
        with pytest.raises(ValueError, match=r"^torch\.inference_mode keeps no gradient"):
            _ = buffers.normal


def test_a_decoder_or_a_model_is_no_field() -> None:
    model = load_model("sofas")
    with pytest.raises(TypeError, match=r"^a Decoder was given where .* model\.field\(code\)$"):
        render(model.decoder, view())
    with pytest.raises(TypeError, match=r"^a Model was given where .* model\.field\(code\)$"):
        check_field(model)
    with pytest.raises(
        TypeError, match=r"^a str was given where a field is needed; give a function from points to distances$"
    ):
        check_field("sofas")


def test_values_are_equal_by_value_and_fit_on_a_line() -> None:
    shape = primitives.sphere(0.5)
    buffers = render(shape, view())
    assert buffers == render(shape, view())
    assert buffers != render(shape, view(azimuth=40))
    assert buffers.occupancy == render(shape, view()).occupancy
    assert TraceConfig(tolerance=torch.ones(3)) == TraceConfig(tolerance=torch.ones(3))
    hits = int(buffers.mask.sum())
    assert repr(buffers) == f"Buffers(float64[24, 24], {hits} of 576 rays hit, radius=1)"
    assert repr(buffers.trace).startswith(f"Trace(float64[24, 24], {hits} hits, ")
    assert repr(buffers.rays) == "Rays(origins=float64[24, 24, 3], directions=float64[24, 24, 3])"


def test_the_clearance_near_an_outline_is_that_of_all_rays_and_inf_elsewhere() -> None:
    buffers = render(primitives.sphere(0.5), Camera.orbit(0, 0, 4, height=24, width=24))
    near = buffers.clearance_near(2)
    square = np.ones((5, 5), dtype=bool)
    mask = buffers.mask.numpy()
    expected = binary_dilation(mask, square) & ~binary_erosion(mask, square)
    assert 0 < expected.sum() < expected.size
    assert (near.isfinite().numpy() == expected).all()
    torch.testing.assert_close(near[near.isfinite()], buffers.clearance[near.isfinite()])
