"""Random views: how they are drawn, what is counted in them, and the bars that they have to pass."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from distrace.benchmarks import agreement as views
from distrace.benchmarks.agreement import ViewRow, badness, largest_part, measure_view, summaries
from distrace.benchmarks.measuring import reference_depth, reference_distance
from distrace.benchmarks.pictures import pictures_of
from distrace.benchmarks.random_views import (
    DISTANCES,
    FOCALS_MM,
    Mixture,
    RandomView,
    Shot,
    aim_at_surface,
    draw_shot,
    model_views,
)
from distrace.camera import Camera
from distrace.checkpoints.model import Model, load_model
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.fields.primitives import box, difference, sphere, union
from distrace.rays import Rays, meet_sphere
from distrace.render import STRATEGIES, render
from distrace.tracing.sphere_tracing import DYNAMIC

SIZES = (16, 32)
SHOT = Shot(azimuth=20.0, elevation=10.0, distance=3.0, focal_mm=40.0, target=(0.0, 0.0, 0.0), size=64)
CAUTIOUS = replace(DYNAMIC, steps=2000, tolerance=1e-6, step_scale=0.9)
BALL = RandomView("ball", None, sphere(0.5), SHOT)


@pytest.fixture(scope="module")
def small() -> Model:
    """A decoder that was never trained."""
    torch.manual_seed(0)
    decoder = Decoder(NetworkSpecs(dims=(16, 16), code_length=4, latent_in=(), norm_layers=()))
    return Model("small", decoder.requires_grad_(False), torch.randn(5, 4), tuple("abcde"))


def test_the_first_views_do_not_depend_on_how_many_follow_and_a_seed_draws_others(small: Model) -> None:
    def drawn(count: int, seed: int) -> list[tuple]:
        return [(view.code, view.shot) for view in model_views(small, count, SIZES, seed)]

    assert drawn(9, 3)[:4] == drawn(4, 3)
    assert drawn(4, 3) != drawn(4, 4)


def test_a_third_of_the_codes_are_mixtures_whose_field_is_that_of_the_code_between(small: Model) -> None:
    all_views = list(model_views(small, 9, SIZES, 0))
    mixed = [view for view in all_views if isinstance(view.code, Mixture)]
    assert len(mixed) == 3
    points = torch.rand(7, 3)
    for view in mixed:
        first, second = small.codes[view.code.first], small.codes[view.code.second]
        between = first + view.code.share * (second - first)
        torch.testing.assert_close(view.sdf(points), small.field(between)(points))
    whole = next(view for view in all_views if isinstance(view.code, int))
    torch.testing.assert_close(whole.sdf(points), small.field(whole.code)(points))


def test_cameras_are_near_and_far_and_their_lenses_wide_and_long() -> None:
    random = np.random.default_rng(0)
    shots = [draw_shot(random, (128, 512)) for _ in range(400)]
    assert all(128 <= shot.size <= 512 and -30 <= shot.elevation <= 70 for shot in shots)
    for name, (low, high) in (("distance", DISTANCES), ("focal_mm", FOCALS_MM)):
        values = [getattr(shot, name) for shot in shots]
        assert low <= min(values) < 1.1 * low
        assert high / 1.1 < max(values) <= high
        assert np.median(values) == pytest.approx(math.sqrt(low * high), rel=0.2), "evenly in the logarithm"
    quadrants = {int(shot.azimuth // 90) for shot in shots}
    assert quadrants == {0, 1, 2, 3}
    octaves = [sum(shot.size**2 for shot in shots if (shot.size > 256) == large) for large in (False, True)]
    assert 0.5 < octaves[0] / octaves[1] < 2, "each octave of sizes costs about the same"


def test_a_shot_stands_where_it_says_and_has_its_target_in_the_middle() -> None:
    shot = replace(SHOT, target=(0.1, -0.2, 0.3))
    camera = shot.camera()
    orbit = Camera.orbit(shot.azimuth, shot.elevation, shot.distance)
    torch.testing.assert_close(camera.T_world_camera[:3, 3], orbit.T_world_camera[:3, 3])
    middle, depth = camera.project(torch.tensor(shot.target))
    torch.testing.assert_close(middle, torch.tensor([32.0, 32.0]), atol=1e-3, rtol=0)
    beside = torch.tensor(shot.target) + shot.pixel(torch.tensor(shot.target)) * camera.T_world_camera[:3, 0]
    torch.testing.assert_close(camera.project(beside)[0], torch.tensor([33.0, 32.0]), atol=1e-3, rtol=0)
    assert depth > 0


def test_a_camera_aims_at_the_surface() -> None:
    solid = box(torch.tensor([0.5, 0.02, 0.3]))
    targets = [torch.tensor(aim_at_surface(SHOT, solid, np.random.default_rng(seed)).target) for seed in range(5)]
    assert all(solid(target[None]).abs() < 1e-3 for target in targets)
    assert len({tuple(target.tolist()) for target in targets}) == 5


def wrong_by(monkeypatch: pytest.MonkeyPatch, shown, view: RandomView = BALL) -> ViewRow:
    """The row of a view where another field is rendered than the reference has."""
    monkeypatch.setattr(views, "render", lambda sdf, camera: render(shown, camera, config=CAUTIOUS))
    return measure_view(view).row


def test_a_right_rendering_passes() -> None:
    row = measure_view(BALL, "cautious", CAUTIOUS).row
    assert (row.missed, row.added, row.iou, row.largest_loss, row.off, row.fails) == (0, 0, 1.0, 0, 0, ())
    true = torch.isfinite(reference_depth(BALL.sdf, SHOT.camera()))
    assert row.pixels == true.sum()
    assert row.evaluations == row.per_pixel * row.pixels > row.pixels
    assert row.strategy == "cautious"


def test_what_is_lost_and_what_is_added_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    hidden = union(sphere(0.5), sphere(0.2, torch.tensor([0.0, 0.7, 0.0])))
    more = wrong_by(monkeypatch, hidden)
    less = wrong_by(monkeypatch, BALL.sdf, replace(BALL, sdf=hidden))
    assert more.missed == less.added == 0
    assert more.added == less.missed == less.largest_loss > 50
    assert more.largest_loss == 0
    assert more.iou == less.iou == pytest.approx(more.pixels / (more.pixels + more.added))
    assert "connected loss" in less.fails
    assert "connected loss" not in more.fails


def test_depths_that_are_off_are_counted_where_both_see_something(monkeypatch: pytest.MonkeyPatch) -> None:
    row = wrong_by(monkeypatch, sphere(0.498))
    assert row.off == row.pixels - row.missed
    assert "depth" in row.fails


def test_a_steep_field_is_measured_against_the_same_reference() -> None:
    steep = RandomView("steep", None, lambda points: torch.tanh(20 * BALL.sdf(points)), SHOT, lipschitz=20.0)
    truth = measure_view(steep, "dynamic", CAUTIOUS).truth
    torch.testing.assert_close(truth, measure_view(BALL, "cautious", CAUTIOUS).truth, atol=1e-5, rtol=0)


def test_parts_are_connected_by_corners_too() -> None:
    mask = np.zeros((6, 6), dtype=bool)
    assert largest_part(mask) == 0
    mask[0, 0] = mask[1, 1] = mask[2, 2] = mask[5, 5] = True
    assert largest_part(mask) == 3


RIGHT = measure_view(BALL, "cautious", CAUTIOUS).row


@pytest.mark.parametrize(
    ("changes", "fails"),
    [
        (dict(pixels=10_000, iou=0.995, missed=8, largest_loss=8, off=2), ()),
        (dict(pixels=10_000, iou=0.9949), ("IoU",)),
        (dict(pixels=10_000, largest_loss=9), ("connected loss",)),
        (dict(pixels=10_000, off=3), ("depth",)),
        (dict(pixels=1_599, iou=0.5, missed=5, added=3, off=1), ()),
        (dict(pixels=1_599, missed=5, added=4), ("wrong pixels",)),
        (dict(pixels=1_600, missed=5, added=4), ()),
        (dict(pixels=0, added=8), ()),
        (dict(pixels=0, added=9), ("wrong pixels",)),
        (dict(pixels=1_599, off=2), ("depth",)),
    ],
    ids=str,
)
def test_a_view_has_to_pass_each_bar(changes: dict, fails: tuple[str, ...]) -> None:
    assert views._fails(replace(RIGHT, **changes)) == fails


def test_a_summary_is_of_all_views_of_a_model() -> None:
    lost = replace(RIGHT, iou=0.9, missed=20, largest_loss=12, off=3, fails=("IoU", "connected loss"))
    other = replace(RIGHT, model="other")
    first, second = summaries([RIGHT, lost, RIGHT, other])
    assert (first.model, first.views, first.failing) == ("ball", 3, 1)
    assert (first.worst_iou, first.median_iou, first.largest_loss) == (0.9, 1.0, 12)
    assert first.off_per_5000 == pytest.approx(5000 * 3 / (3 * RIGHT.pixels - 20))
    assert first.bar == "fails: IoU, connected loss"
    assert (second.model, second.views, second.bar) == ("other", 1, "met")
    (middling,) = summaries([replace(RIGHT, iou=0.999)])
    assert middling.bar == "fails: median IoU"


def test_a_ray_that_starts_in_the_solid_sees_nothing_and_one_in_a_hollow_sees_its_wall() -> None:
    rays = Rays(torch.zeros(2, 3), torch.tensor([[0.0, 0, 1], [1, 0, 0]]))
    assert (reference_distance(sphere(0.5), rays, meet_sphere(rays)) == torch.inf).all()
    hollow = difference(sphere(0.7), sphere(0.5))
    found = reference_distance(hollow, rays, meet_sphere(rays))
    torch.testing.assert_close(found, torch.tensor([0.5, 0.5]), atol=2e-6, rtol=0)


def test_the_reference_does_not_look_before_the_ray_begins() -> None:
    """Bisection over the last 0.02 would begin at -0.015, in the solid behind the eye."""
    walls = union(box(torch.tensor([0.5, 0.5, 0.1])), sphere(0.1, torch.tensor([0.0, 0, 0.21])))
    rays = Rays(torch.tensor([[0.0, 0, 0.105]]), torch.tensor([[0.0, 0, 1]]))
    found = reference_distance(walls, rays, meet_sphere(rays))
    torch.testing.assert_close(found, torch.tensor([0.005]), atol=2e-6, rtol=0)


def test_pictures_are_cropped_to_the_object_and_a_view_with_more_wrong_pixels_is_worse() -> None:
    coarse = replace(CAUTIOUS, steps=3)
    bad = measure_view(RandomView("ball", Mixture(1, 2, 0.25), sphere(0.5), SHOT), "coarse", coarse)
    good = measure_view(BALL, "coarse", CAUTIOUS)
    assert bad.row.fails
    assert badness(bad) > badness(good)
    reference, rendered, masks = pictures_of(bad)
    assert (reference != 255).any(-1).sum() == (masks != 255).any(-1).sum() > (rendered != 255).any(-1).sum()
    height, width, _ = reference.shape
    assert 128 < max(height, width) <= 256, "cropped, and enlarged"
    assert (masks != 255).any(-1).mean() > 0.4
    assert (masks == 255).all(-1)[:4].all(), "with a margin"


def test_a_bundled_model_is_measured_as_it_is() -> None:
    (view,) = model_views(load_model("sofas"), 1, (16, 16), 0)
    row = measure_view(view, "dynamic", STRATEGIES["dynamic"]).row
    assert row.model == "sofas"
    assert row.pixels > 0
    assert row.camera.size == 16


def test_sizes_that_no_image_has_are_refused() -> None:
    for sizes in ((0, 4), (9, 8)):
        with pytest.raises(ValueError, match=f"sizes from {sizes[0]} to {sizes[1]}"):
            draw_shot(np.random.default_rng(0), sizes)


def test_a_view_of_nothing_has_a_picture_too() -> None:
    nothing = measure_view(
        RandomView("nothing", None, sphere(0.5, torch.tensor([0.0, 9, 0])), SHOT), "cautious", CAUTIOUS
    )
    assert all((picture == 255).all() and picture.shape == (256, 256, 3) for picture in pictures_of(nothing))
