"""The camera of one view: residuals and their Jacobian, and that cameras are found again."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from photographed import EXACT
from torch import Tensor

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.fields import primitives
from distrace.fields.base import SDF
from distrace.fitting.alignment import Accuracy, Still, residuals
from distrace.fitting.fit_camera import AGREES_IF_REPEATED, CameraConfig, fit_camera
from distrace.fitting.visibility import ObservedRays, outline_of, rays_of
from distrace.pose import pose_error, turned_object, zoomed
from distrace.render import render, render_rays
from distrace.tracing.sphere_tracing import DYNAMIC

f64 = torch.float64
BALL = primitives.sphere(0.5, torch.tensor([0.1, 0.05, -0.1], dtype=f64))


def shape(points: Tensor) -> Tensor:
    """Nothing in it is symmetric: a rounded corner of three bars of different lengths."""
    bars = [
        primitives.capsule(points.new_zeros(3), points.new_tensor(end), 0.16)(points)
        for end in ([0.7, 0.0, 0.0], [0.0, 0.5, 0.1], [-0.1, -0.1, -0.4])
    ]
    return torch.stack(bars).amin(0)


@cache
def view(sdf: SDF = shape, size: int = 64, dtype: torch.dtype = f64) -> View:
    camera = Camera.orbit(40, 25, 4.5, height=size, width=size, dtype=dtype)
    with torch.no_grad():
        buffers = render(sdf, camera, config=EXACT)
    return View(camera, buffers.depth, buffers.mask, buffers.normal)


def only(observed: View, *kept: str) -> View:
    return observed.without(*{"depth", "mask", "normal"}.difference(kept))


def turned(camera: Camera, degrees: float, shift: tuple[float, float, float] = (0.05, -0.04, 0.1)) -> Camera:
    axis = camera.intrinsics.new_tensor([0.6, -0.64, 0.48])
    return turned_object(camera, axis * math.radians(degrees), camera.intrinsics.new_tensor(shift))


def found(observed: View, start: Camera, config: CameraConfig = CameraConfig()) -> Camera:
    steps = list(fit_camera(shape, observed, start, config))
    assert steps[-1].evaluations > 0
    return steps[-1].camera


class TestSight:
    def test_without_a_mask_all_rays_are_on_the_object(self) -> None:
        sight = rays_of(only(view(), "depth"), 90)
        assert len(sight.pixels) == 90
        assert sight.is_object.all()
        assert not sight.is_background.any()
        assert sight.depth.isfinite().all()

    def test_with_a_mask_two_thirds_are_by_its_outline_and_around_it(self) -> None:
        observed = view()
        sight = rays_of(observed, 90)
        assert (sight.is_object != sight.is_background).all()
        assert 20 < sight.is_background.sum() < 60
        assert observed.mask is not None
        column, row = (sight.pixels - 0.5).long().T
        assert (observed.mask[row, column] == sight.is_object).all()
        nearest = (sight.pixels - 0.5 - sight.outside).long()
        assert observed.mask[nearest[:, 1], nearest[:, 0]].all()
        assert ((sight.outside.norm(dim=-1) > 0) == sight.is_background).all()

    def test_normals_are_in_the_cameras_axes(self) -> None:
        sight = rays_of(only(view(), "normal"), 60)
        assert sight.has_normal.all()
        assert (sight.normal[:, 2] < 0.1).all()  # they face the camera, which looks along z

    def test_the_outline_passes_between_pixels(self) -> None:
        mask = torch.zeros(5, 6, dtype=torch.bool)
        mask[1:3, 2:5] = True
        centres = Camera.orbit(0, 0, 4, height=5, width=6).pixels()
        sight = outline_of(mask, centres, 100)
        assert len(sight.pixels) == 10  # around 2 × 3 pixels
        assert [2.0, 1.5] in sight.pixels.tolist()
        assert [2.5, 1.0] in sight.pixels.tolist()
        assert (sight.is_object & sight.is_background).all()
        assert len(outline_of(mask, centres, 4).pixels) == 4


@pytest.mark.parametrize("kind", ["depth", "object ray", "outline", "astray", "normal"])
@pytest.mark.parametrize("unknown", range(7), ids=["turn x", "turn y", "turn z", "right", "down", "ahead", "focal"])
def test_jacobians_are_the_derivatives_of_residuals(kind: str, unknown: int) -> None:
    """Against differences, at a camera that is a little off; on a ball, whose every normal bends alike."""
    observed = view(BALL, 32)
    start, sight = turned(observed.camera, 3), _rays(kind, observed)
    still, step = Still.of(BALL, start.intrinsics), 1e-5

    def at(h: float) -> Tensor:
        delta = torch.zeros(7, dtype=f64)
        delta[unknown] = h
        moved = zoomed(turned_object(start, delta[:3], delta[3:6]), delta[6])
        return residuals(still, sight, moved, Accuracy(), focal=True).values

    here = residuals(still, sight, start, Accuracy(), focal=True)
    differences = (at(step) - at(-step)) / (2 * step)
    assert len(here.values) >= 5
    scale = here.jacobian.abs().max().item()
    assert scale > 1
    close = (here.jacobian[:, unknown] - differences).abs() < (0.3 if kind == "object ray" else 2e-2) * scale
    assert close.float().mean() > 0.8  # a hit is found to 3e-4, and the least value not sought on a ray that misses


def _rays(kind: str, observed: View) -> ObservedRays:
    """Twenty rays or so of which all residuals are of one kind."""
    assert observed.mask is not None
    centres = observed.camera.pixels()
    if kind == "outline":
        return outline_of(observed.mask, centres, 40)
    sight = rays_of(only(observed, "normal" if kind == "normal" else "depth"), 40)
    unknown = torch.full_like(sight.depth, torch.inf)
    if kind in ("object ray", "astray"):
        moved = sight.pixels + (60 if kind == "astray" else 11)
        return replace(sight, depth=unknown, pixels=moved)
    return sight if kind == "normal" else replace(sight, depth=_rendered(sight, observed))


def _rendered(rays: ObservedRays, observed: View) -> Tensor:
    """The depths that the start shows: where a residual is zero, what its slope does to it is, too."""
    with torch.no_grad():
        depth = render_rays(BALL, turned(observed.camera, 3), rays.pixels, config=DYNAMIC).depth
    return depth


@pytest.mark.parametrize("kept", [("depth",), ("depth", "mask", "normal")], ids=str)
def test_a_camera_twenty_degrees_off_is_found(kept: tuple[str, ...]) -> None:
    observed = view(dtype=torch.float32)
    degrees, percent = pose_error(found(only(observed, *kept), turned(observed.camera, 20)), observed.camera)
    assert degrees < 0.5
    assert percent < 0.5


@pytest.mark.slow
def test_from_the_outline_alone_most_cameras_twenty_degrees_off_are_found() -> None:
    """Of 64 pixels: it tells no more than a degree, and some starts end where another outline is nearly the same."""
    observed = view(dtype=torch.float32)
    ends = [found(only(observed, "mask"), turned(observed.camera, degrees)) for degrees in (18, 19, 20, 21, 22)]
    errors = [pose_error(end, observed.camera) for end in ends]
    assert sum(degrees < 1 and percent < 1 for degrees, percent in errors) >= 3


@pytest.mark.slow
def test_from_normals_alone_the_orientation_is_found() -> None:
    observed = view(dtype=torch.float32)
    degrees, _ = pose_error(found(only(observed, "normal"), turned(observed.camera, 10)), observed.camera)
    assert degrees < 0.5


def test_where_one_start_leads_nowhere_another_does() -> None:
    observed = view(dtype=torch.float32)
    start = turned(observed.camera, 70)
    steps = list(fit_camera(shape, only(observed, "depth", "mask"), start))
    assert steps[-1].start > 0
    assert pose_error(steps[-1].camera, observed.camera)[0] < 0.5
    alone = list(fit_camera(shape, only(observed, "depth", "mask"), start, CameraConfig(starts=1)))
    assert {step.start for step in alone} == {0}
    assert pose_error(alone[-1].camera, observed.camera)[0] > 5


def test_a_camera_that_looks_away_is_turned_to_the_object() -> None:
    observed = view(dtype=torch.float32)
    away = turned_object(observed.camera, torch.zeros(3), torch.tensor([0, 6.0, 0]))
    assert pose_error(found(observed, away), observed.camera)[0] < 0.5


def test_a_focal_length_is_found_with_the_pose() -> None:
    observed = view(dtype=torch.float32)
    start = zoomed(turned(observed.camera, 8), torch.tensor(1.2).log())
    camera = found(only(observed, "depth", "mask"), start, CameraConfig(focal=True))
    assert float(camera.intrinsics[0, 0] / observed.camera.intrinsics[0, 0]) == pytest.approx(1, abs=5e-3)
    assert pose_error(camera, observed.camera)[0] < 0.5
    kept = found(only(observed, "depth", "mask"), start, CameraConfig(starts=1))
    torch.testing.assert_close(kept.intrinsics, start.intrinsics)


def test_outliers_among_the_depths_hardly_matter() -> None:
    observed = view(dtype=torch.float32)
    depth, random = observed.depth.clone(), torch.Generator().manual_seed(0)
    wrong = observed.seen & (torch.rand(depth.shape, generator=random) < 0.15)
    depth[wrong] += 0.3 * torch.rand(int(wrong.sum()), generator=random) + 0.05
    steps = list(fit_camera(shape, replace(observed, depth=depth, normal=None), turned(observed.camera, 15)))
    degrees, percent = pose_error(steps[-1].camera, observed.camera)
    assert degrees < 0.5
    assert percent < 0.5
    assert max(step.start for step in steps) < 3, "two starts that end at the same camera are enough"


def test_steps_tell_where_the_search_stands() -> None:
    observed = view(dtype=torch.float32)
    steps = list(fit_camera(shape, only(observed, "depth", "mask"), turned(observed.camera, 10)))
    assert steps[0].off > 0.2 > 0.1 > steps[-1].off
    assert [step.evaluations for step in steps] == sorted(step.evaluations for step in steps)
    assert all(step.seconds > 0 for step in steps)


def test_a_coarse_view_agrees_with_its_camera_and_with_no_other() -> None:
    observed = view(size=48, dtype=torch.float32)
    once = CameraConfig(starts=1)
    assert list(fit_camera(shape, observed, observed.camera, once))[-1].off < 0.005
    *_, wrong = fit_camera(shape, observed, turned(observed.camera, 180), once)
    assert pose_error(wrong.camera, observed.camera)[0] > 5
    assert wrong.off > AGREES_IF_REPEATED


def test_a_view_of_nothing_is_refused() -> None:
    observed = only(view(), "mask")
    empty = replace(observed, mask=torch.zeros_like(observed.seen))
    with pytest.raises(ValueError, match="shows nothing of the object"):
        list(fit_camera(shape, empty, observed.camera))


@pytest.mark.parametrize("wrong", [{"starts": 0}, {"rays": 3}])
def test_a_configuration_that_fits_nothing_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="starts and"):
        CameraConfig(**wrong)
