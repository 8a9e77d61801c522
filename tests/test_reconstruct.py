"""Weights fitted to photographs: of painted bumpy balls, whose shape and colours are known."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import roma
import torch
import trimesh
from bumpy import bumpy_balls
from photographed import EXACT
from test_fit_photos import TRUE, paint, ring
from torch.nn import functional as F

from distrace.boundary import shade
from distrace.camera import Camera
from distrace.cli import main
from distrace.cli.console import start
from distrace.cli.reconstruct import parted, without
from distrace.cli.reconstructed import Reconstructed
from distrace.data.background_segmentation import masked
from distrace.data.photograph import Photograph
from distrace.data.photographs import Photographs, UnitSphere, load_photographs, save_photographs
from distrace.fields.base import SDF, value_and_gradient
from distrace.fields.primitives import box, sphere, torus
from distrace.mesh import MeshConfig
from distrace.photos.visual_hull import mask_overlaps, visual_hull
from distrace.pose import exp_se3
from distrace.rays import Rays, meet_sphere
from distrace.reconstruction.cameras import interpolated_step, moved, pixel_shift, registered
from distrace.reconstruction.losses import MARCH, PixelSampler, loss_terms, surface_colours
from distrace.reconstruction.matching import PatchMatching
from distrace.reconstruction.multiview_depth import NO_DEPTHS
from distrace.reconstruction.networks import (
    ColourNetwork,
    GridSpecs,
    HashGrid,
    SurfaceNetwork,
    SurfaceSpecs,
    squareplus,
)
from distrace.reconstruction.reconstruct import initialise, reconstruct
from distrace.reconstruction.state import (
    ReconstructConfig,
    Reconstruction,
    fingerprint,
    load_reconstruction,
    save_reconstruction,
)
from distrace.render import render
from distrace.report.reconstruction_page import compared_view
from distrace.surface import attach
from distrace.tracing.sphere_tracing import sphere_trace

BLACK = torch.zeros(3)
CPU = torch.device("cpu")
SMALL = SurfaceSpecs(
    width=32, layers=2, frequencies=3, features=4, grid=GridSpecs(levels=3, finest=32, entries=512), colour_width=32
)
SHORT = ReconstructConfig(steps=110, initial_steps=150, sizes=(32,), rays=256, learning_rate=5e-3, refinement_steps=30)


Command = Callable[..., None]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Iterator[Command]:
    """The command line, in this process; whatever it sets for the process is set back."""

    def command(*arguments: object) -> None:
        monkeypatch.setattr("sys.argv", ["distrace", "reconstruct", *map(str, arguments)])
        main()

    yield command
    torch.set_flush_denormal(False)


@pytest.fixture(scope="module")
def views() -> list[Photograph]:
    field = bumpy_balls(0.35).field(TRUE)
    made = []
    for number, camera in enumerate(ring(8, 40)):
        with torch.no_grad():
            buffers = render(field, camera)
            made.append(Photograph(f"{number:02}", camera, shade(buffers, paint, BLACK), buffers.mask))
    return made


@pytest.fixture(scope="module")
def fitted(views: list[Photograph]) -> Reconstruction:
    state = Reconstruction.fresh(SMALL, SHORT, 7, CPU)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("distrace.photos.visual_hull.CELLS", 80)
        list(reconstruct(views[1:], state, SHORT))
    return state


def test_a_surface_network_starts_as_a_ball() -> None:
    torch.manual_seed(0)
    surface = SurfaceNetwork(SurfaceSpecs(radius=0.5))
    directions = F.normalize(torch.randn(200, 3), dim=-1)
    value, gradient = value_and_gradient(surface, 0.5 * directions)
    assert value.abs().max() < 0.3
    assert (gradient * directions).sum(-1).mean() > 0.8


def test_light_depends_on_normal_direction_and_place_alone() -> None:
    torch.manual_seed(0)
    colour = ColourNetwork(SMALL)
    points = torch.randn(2, 3)
    features = torch.randn(2, SMALL.features)
    normals, directions = F.normalize(torch.randn(2, 2, 3), dim=-1)

    def seen(n: torch.Tensor, v: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
        return colour(place.expand(2, 3), n.expand(2, 3), v.expand(2, 3), features).logit()

    def lit(place: torch.Tensor) -> torch.Tensor:
        return seen(normals[0], directions[0], place) - seen(normals[1], directions[1], place)

    here = lit(points[0])
    there = lit(points[1])
    assert torch.allclose(here[0], here[1], atol=1e-5), "features took part"
    assert not torch.allclose(here, torch.zeros_like(here), atol=1e-3)
    assert not torch.allclose(here, there, atol=1e-3)


def test_squareplus_is_smooth_and_close_to_relu() -> None:
    x = torch.linspace(-1, 1, 201, dtype=torch.float64, requires_grad=True)
    assert (squareplus(x) - x.relu()).abs().max() < 0.0071  # IDR's softplus: log 2 / 100
    assert torch.autograd.gradcheck(squareplus, x)
    assert torch.autograd.gradgradcheck(squareplus, x)


def test_a_fit_renders_a_held_out_view(views: list[Photograph], fitted: Reconstruction) -> None:
    before = compared_view(Reconstruction.fresh(SMALL, SHORT, 8, CPU), views[0], 40)
    after = compared_view(fitted, views[0], 40)
    assert after.silhouette_iou > max(0.9, before.silhouette_iou)
    assert after.psnr > before.psnr + 3
    assert fitted.evaluations > SHORT.steps * SHORT.rays
    first, last = fitted.loss_history["colour"]
    assert last < first


def test_a_grid_is_linear_between_its_corners_and_even_beyond_the_cube() -> None:
    grid = HashGrid(GridSpecs(levels=2, coarsest=4, finest=8, entries=1000)).double()
    a = torch.tensor([0.3, -0.2, 0.9])  # in one cell of both levels
    b = torch.tensor([0.45, -0.2, 0.9])
    ends = grid(torch.stack([a, b, (a + b) / 2]).double())
    assert torch.allclose(ends[2], ends[:2].mean(0))
    assert torch.equal(grid(torch.tensor([[2.0, 0.1, -3.0]])), grid(torch.tensor([[1.0, 0.1, -1.0]])))
    points = (2 * torch.rand(20, 3, dtype=torch.float64) - 1).requires_grad_()
    assert torch.autograd.gradcheck(grid, points)


def test_each_corner_has_its_entry_and_fine_grids_share_theirs() -> None:
    grid = HashGrid(GridSpecs(levels=2, coarsest=4, finest=32, entries=125))
    corners = torch.cartesian_prod(*[torch.linspace(-1, 1, 5)] * 3)
    assert len(grid(corners)[:, :2].unique(dim=0)) == 125
    assert grid(torch.zeros(0, 3)).shape == (0, 4)
    with pytest.raises(ValueError, match="makes no grids; at least one level"):
        GridSpecs(levels=0)


def test_colour_refinement_changes_colours_alone(views: list[Photograph], fitted: Reconstruction) -> None:
    config = replace(SHORT, refinement_steps=60)
    state = deepcopy(fitted)
    training = views[1:]
    before = compared_view(state, training[0], 40)
    list(reconstruct(training, state, config))
    assert state.step == config.total == fitted.step + 30
    after = compared_view(state, training[0], 40)
    assert after.psnr > before.psnr
    assert after.silhouette_iou == before.silhouette_iou
    for one, other in zip(state.surface.parameters(), fitted.surface.parameters(), strict=True):
        assert torch.equal(one, other)
    assert torch.equal(state.camera_steps, fitted.camera_steps)


def test_without_a_surface_there_is_no_colour_refinement(views: list[Photograph], fitted: Reconstruction) -> None:
    state = deepcopy(fitted)
    with torch.no_grad():
        state.surface.last.bias[0] += 5.0
    assert list(reconstruct(views[1:], state, replace(SHORT, refinement_steps=60))) == []


def test_motions_turn_shift_and_leave_the_whole_in_place(views: list[Photograph]) -> None:
    steps = torch.tensor([[0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.5], [0.0] * 6])
    turned, still = exp_se3(steps[:, :3], steps[:, 3:])
    assert torch.allclose(turned @ torch.tensor([1.0, 0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.5, 1.0]), atol=1e-6)
    assert torch.equal(still, torch.eye(4))
    assert pixel_shift(views[0], moved(views[0], still)) == 0.0
    state = Reconstruction.fresh(SMALL, SHORT, 2, CPU)
    state.camera_steps = steps[:1].expand(2, 6)
    assert torch.equal(state.motions(), torch.eye(4).expand(2, 4, 4)), "all cameras moved alike would move the object"
    nudge = torch.tensor([[0.0, 0.0, 0.0, 0.03, 0.0, 0.0]])
    pool = PixelSampler.of(views[:1]).pixels
    there = PixelSampler.of([moved(views[0], exp_se3(nudge[0, :3], nudge[0, 3:]))]).pixels
    again = pool.moved(exp_se3(nudge[:, :3], nudge[:, 3:]))
    assert torch.allclose(again.rays.origins[0], there.rays.origins[0], atol=1e-6)
    assert torch.allclose(again.rays.directions.mean(0), there.rays.directions.mean(0), atol=1e-2)


def test_a_camera_between_two_moves_as_they_do() -> None:
    eyes = 3 * F.normalize(torch.tensor([[1.0, 0, 0], [1.0, 0, 1.0], [-1.0, 0, 0]]), dim=-1)
    steps = torch.arange(18.0).reshape(3, 6)
    halfway = F.normalize(F.normalize(eyes[:2], dim=-1).sum(0), dim=0)
    torch.testing.assert_close(interpolated_step(steps, eyes, halfway), steps[:2].mean(0))
    torch.testing.assert_close(interpolated_step(steps, eyes, 2 * eyes[2]), steps[2], atol=1e-3, rtol=0)
    torch.testing.assert_close(interpolated_step(steps[:1], eyes[:1], eyes[2]), steps[0])


@pytest.mark.slow
def test_a_disturbed_camera_is_registered(views: list[Photograph], fitted: Reconstruction) -> None:
    off = moved(views[0], exp_se3(torch.tensor([0.05, -0.04, 0.03]), torch.tensor([0.05, 0.0, -0.08])))
    found = registered(fitted, off, SHORT)
    assert pixel_shift(views[0], found) < pixel_shift(views[0], off) / 2, (
        pixel_shift(views[0], found),
        pixel_shift(views[0], off),
    )
    assert all(parameter.requires_grad for parameter in fitted.surface.parameters())


def test_colours_pull_at_the_shape_exactly(views: list[Photograph], fitted: Reconstruction) -> None:
    """The derivatives of colours with respect to the surface's last bias are those of finite differences."""
    surface = deepcopy(fitted.surface).double()
    colour = deepcopy(fitted.colour).double()
    rays = PixelSampler.of(views[1:3]).pixels.rays
    bias = surface.last.bias
    rays = Rays(rays.origins.double(), F.normalize(rays.directions.double(), dim=-1))
    march = replace(MARCH, tolerance=1e-13, steps=400, step_scale=0.8)
    trace = sphere_trace(surface, rays, meet_sphere(rays), march)
    rays = rays[trace.hit]
    distance = trace.distance[trace.hit]
    red = surface_colours(surface, colour, rays.at(attach(surface, rays, distance)), rays.directions)[::29, 0]
    exact = torch.stack([torch.autograd.grad(each, bias, retain_graph=True)[0][0] for each in red])
    few = Rays(rays.origins[::29], rays.directions[::29])
    step = 1e-6
    found = []
    for sign in (1, -1):
        with torch.no_grad():
            bias[0] += sign * step
            again = sphere_trace(surface, few, meet_sphere(few), march).distance
            found.append(surface_colours(surface, colour, few.at(again), few.directions)[:, 0])
            bias[0] -= sign * step
    off = ((found[0] - found[1]) / (2 * step) - exact).abs()
    assert off.median() < 1e-7
    assert off.quantile(0.95) < 1e-5  # between them are kinks of the colours' network, which are ReLU's


@pytest.fixture
def coarse_hull(monkeypatch: pytest.MonkeyPatch) -> None:
    """In an eighth of the time: the object is coarse, too."""
    monkeypatch.setattr("distrace.photos.visual_hull.CELLS", 80)


@pytest.mark.usefixtures("coarse_hull")
def test_the_hull_of_a_ball_is_a_ball_and_initialises_a_network(views: list[Photograph]) -> None:
    cameras = [view.camera.resized(3.0) for view in views]
    hull = visual_hull(seen_by(sphere(0.5), cameras))
    directions = F.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    directions[:, 1] *= 0.3  # the cameras see it from the side
    directions = F.normalize(directions, dim=-1)
    assert hull(0.5 * directions).abs().median() < 0.03
    assert (hull(0.3 * directions) < -0.1).all()
    assert (hull(0.9 * directions) > 0.2).all()
    state = Reconstruction.fresh(SMALL, SHORT, 8, CPU)
    initialise(state, hull, SHORT, NO_DEPTHS)
    assert state.surface(0.5 * directions).abs().median() < 0.04


@pytest.mark.usefixtures("coarse_hull")
def test_masks_with_nothing_in_common_are_refused(views: list[Photograph]) -> None:
    empty = [replace(view, mask=torch.zeros_like(view.image[..., 0]).bool()) for view in views]
    with pytest.raises(ValueError, match="nothing lies within the masks of 8 views together"):
        visual_hull(empty)


def seen_by(sdf: SDF, cameras: Sequence[Camera]) -> list[Photograph]:
    with torch.no_grad():
        masks = [render(sdf, camera, config=EXACT).mask for camera in cameras]
    images = [torch.ones(*mask.shape, 3) for mask in masks]
    return [Photograph(f"{number:02}", *parts) for number, parts in enumerate(zip(cameras, images, masks, strict=True))]


def turned(view: Photograph, degrees: float) -> Photograph:
    """The same photograph, its camera said to be turned about the world's x axis."""
    turn = torch.eye(4)
    turn[:3, :3] = roma.rotvec_to_rotmat(torch.tensor([math.radians(degrees), 0.0, 0.0]))
    return replace(view, camera=replace(view.camera, T_world_camera=turn @ view.camera.T_world_camera))


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_hull")
def test_a_view_whose_camera_is_turned_is_an_outlier() -> None:
    seen = seen_by(box(torch.tensor([0.1, 0.6, 0.2])), [camera.resized(2.0) for camera in ring(16, 40)])
    assert not any(view.is_outlier for view in mask_overlaps(seen))
    found = mask_overlaps([*seen[:2], turned(seen[2], 15.0), *seen[3:]])
    assert [view.name for view in found if view.is_outlier] == ["02"]


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_hull")
def test_a_view_that_alone_sees_through_a_hole_is_no_outlier() -> None:
    around = [Camera.orbit(360 * k / 12, 0, 3.0, height=64, width=64, focal_px=80.0) for k in range(12)]
    above = Camera.orbit(0, 89, 3.0, height=64, width=64, focal_px=80.0)
    *others, view = seen_by(torus(0.5, 0.15), [*around, above])
    *_, last = mask_overlaps([*others, view])
    assert last.iou < 0.85, "the hull of the others has no hole"
    assert not last.is_outlier
    aside = above.T_world_camera.clone()
    aside[0, 3] += 0.5
    wrong = replace(view, camera=replace(above, T_world_camera=aside))
    assert mask_overlaps([*others, wrong])[-1].is_outlier, "it rules out a part that others show"


def test_a_view_is_left_out_by_its_name(views: list[Photograph]) -> None:
    assert [view.name for view in without(views[:3], ["01"])] == ["00", "02"]
    with pytest.raises(ValueError, match="--leave-out x y: no such view; there are 00, 01"):
        without(views[:2], ["y", "x"])


def test_without_colours_only_outlines_pull(views: list[Photograph]) -> None:
    state = Reconstruction.fresh(SMALL, SHORT, 8, CPU)
    random = torch.Generator().manual_seed(0)
    small = [view.at_most(32) for view in views]
    some = PixelSampler.of(small).sample(600, random)
    matching = PatchMatching.of(small, CPU)
    surface = state.surface
    for shapes, pulled in ((False, set[str]()), (True, {"colour", "patches"})):
        terms = loss_terms(some, matching, surface, state.colour, random, shapes, 100.0)
        weights = list(state.surface.parameters())
        for name in ("colour", "patches"):
            if terms[name].requires_grad:
                found = torch.autograd.grad(terms[name], weights, retain_graph=True, allow_unused=True)
                assert any(each is not None and each.any() for each in found) == (name in pulled)
            else:
                assert name not in pulled
    assert surface.evaluations > 2 * 600


@pytest.mark.slow
def test_a_stopped_run_goes_on_as_if_it_had_not_been(views: list[Photograph], tmp_path: Path) -> None:
    config = replace(SHORT, steps=12, sizes=(16, 32))
    fingerprints = [fingerprint(view) for view in views]
    whole = Reconstruction.fresh(SMALL, config, 8, CPU)
    list(reconstruct(views, whole, config))
    half = Reconstruction.fresh(SMALL, config, 8, CPU)
    for step in reconstruct(views, half, config):
        if step == 5:
            break
    save_reconstruction(tmp_path, half, config, fingerprints)
    again = load_reconstruction(tmp_path, config, SMALL, fingerprints, CPU)
    assert again.step == 5
    list(reconstruct(views, again, config))
    for one, other in zip(whole.surface.parameters(), again.surface.parameters()):
        assert torch.equal(one, other)
    with pytest.raises(ValueError, match="other rays, width; give the same, or another --out"):
        load_reconstruction(tmp_path, replace(config, rays=8), replace(SMALL, width=8), fingerprints, CPU)
    with pytest.raises(ValueError, match="of a run with other photographs; give the same, or another --out"):
        load_reconstruction(tmp_path, config, SMALL, [*fingerprints[1:], fingerprint(turned(views[0], 1.0))], CPU)
    stored = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    for tampered in ({"loss_history": {"patches": False}}, {"loss_history": 3}, {"step": "five"}, {"seconds": None}):
        torch.save(stored | tampered, tmp_path / "checkpoint.pt")
        with pytest.raises(ValueError, match="is not a checkpoint of a reconstruction; move it away"):
            load_reconstruction(tmp_path, config, SMALL, fingerprints, CPU)
    (tmp_path / "checkpoint.pt").write_bytes(b"no")
    with pytest.raises(ValueError, match="is not a checkpoint of a reconstruction; move it away"):
        load_reconstruction(tmp_path, config, SMALL, fingerprints, CPU)


def test_a_dark_background_gives_masks(views: list[Photograph]) -> None:
    random = torch.Generator().manual_seed(0)
    noisy = [
        replace(view, image=(view.image + 0.02 * torch.rand(view.image.shape, generator=random)).clamp(0, 1), mask=None)
        for view in views
    ]
    found = masked(Photographs(tuple(noisy), UnitSphere(torch.zeros(3).double(), 2.0), "ours"))
    for view, truth in zip(found.views, views, strict=True):
        assert view.mask is not None
        assert truth.mask is not None
        assert (view.mask & truth.mask).sum() / (view.mask | truth.mask).sum() > 0.9
        there = found.unit_sphere.camera_to_world(view.camera).T_world_camera
        assert torch.allclose(there[:3, 3], 2 * truth.camera.T_world_camera[:3, 3], atol=1e-5)
    bright = [replace(view, image=1 - view.image) for view in noisy]
    with pytest.raises(ValueError, match="00 and 7 others have no mask, and their background is not dark"):
        masked(Photographs(tuple(bright), found.unit_sphere, "ours"))


def test_every_so_manieth_view_is_held_out(views: list[Photograph]) -> None:
    training, apart = parted(views, 4)
    assert [view.name for view in apart] == ["01", "05"]
    assert len(training) == 6
    assert parted(views, 0) == (views, [])
    empty = replace(views[1], mask=torch.zeros_like(views[1].known_mask))
    assert [view.name for view in parted([views[0], empty, *views[2:]], 4)[1]] == ["05"]
    for every in (-1, 1):
        with pytest.raises(ValueError, match=f"--held-out {every}"):
            parted(views, every)


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_hull")
def test_the_command_writes_a_mesh_in_the_folders_world(
    views: list[Photograph], tmp_path: Path, run: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("distrace.cli.reconstruct.ReconstructConfig", partial(ReconstructConfig, initial_steps=150))
    monkeypatch.setattr("distrace.cli.reconstruct.PREVIEWS", 2)
    monkeypatch.setattr("distrace.cli.reconstructed.FITTED_SHOWN", 1)
    monkeypatch.setattr("distrace.reconstruction.cameras.STEPS", 5)
    unit_sphere = UnitSphere(torch.tensor([3.0, 0, 0]).double(), 2.0)
    save_photographs(tmp_path / "views", Photographs(tuple(views), unit_sphere, "ours"))
    out = tmp_path / "out"
    few = ["--steps", 30, "--retouching", 5, "--sizes", 16, 32, "--rays", 128, "--width", 16]
    run(tmp_path / "views", "--out", out, *few, "--resolution", 32, "--held-out", 4, "--format", "ply", "obj")
    wanted = {"mesh.ply", "mesh.obj", "report.html", "result.json", "config.json", "checkpoint.pt", "forming.gif"}
    assert wanted <= {path.name for path in out.iterdir()}
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [30, 35]
    assert {"seconds", "loss", "learning_rate", "colour", "patches", "outline", "eikonal"} <= lines[0].keys()
    assert lines[0]["loss"] > lines[0]["colour"]
    result = json.loads((out / "result.json").read_text())
    assert result["rows"][0]["views_held_out"] == 2
    assert result["rows"][0]["method"] == "ours"
    assert {"psnr", "psnr_corrected", "psnr_aligned"} <= result["rows"][0].keys()
    for frame in json.loads((out / "transforms.json").read_text())["frames"]:
        assert (out / frame["file_path"]).is_file()
        pose = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        assert np.array_equal(pose, result["cameras"][Path(frame["file_path"]).stem]["T_world_camera"])
    for name in ("mesh.ply", "mesh.obj"):
        mesh = trimesh.load(out / name)
        assert np.asarray(mesh.bounds).mean(0) == pytest.approx([3.0, 0, 0], abs=0.8)
        assert len(np.unique(np.asarray(mesh.visual.vertex_colors), axis=0)) > 1


def test_views_that_were_read_from_no_file_are_saved_without_transforms(
    views: list[Photograph], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("distrace.cli.reconstructed.FITTED_SHOWN", 1)
    unit_sphere = UnitSphere(torch.tensor([3.0, 0, 0]).double(), 2.0)
    few = views[:2]
    save_photographs(tmp_path / "views", Photographs(tuple(few), unit_sphere, "ours"))
    read = load_photographs(tmp_path / "views").views[0]
    config = replace(SHORT, sizes=(16,))
    state = Reconstruction.fresh(SMALL, config, len(few), CPU)
    found = Reconstructed("balls", state, config, unit_sphere, [read, few[1]], [])
    found.save(start(tmp_path / "out"), MeshConfig(16), ["ply"])
    cameras = json.loads((tmp_path / "out" / "result.json").read_text())["cameras"]
    assert list(cameras) == [view.name for view in few]
    for view in few:
        expected = unit_sphere.camera_to_world(view.camera).T_world_camera
        torch.testing.assert_close(torch.tensor(cameras[view.name]["T_world_camera"]), expected)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["images/00.png"]


def test_photographs_without_masks_end_in_one_sentence(
    views: list[Photograph], tmp_path: Path, run: Command, capsys: pytest.CaptureFixture
) -> None:
    bright = tuple(replace(view, image=1 - view.image, mask=None) for view in views)
    save_photographs(tmp_path / "views", Photographs(bright, UnitSphere(torch.zeros(3).double(), 1.0), "ours"))
    with pytest.raises(SystemExit) as stop:
        run(tmp_path / "views", "--out", tmp_path / "o")
    assert stop.value.code == 2
    assert "give masks, white where the object is" in " ".join(capsys.readouterr().err.split())
