"""Pictures of a sphere whose colours are known beforehand."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from seen_ball import BALL, camera_and_buffers

from distrace import shading
from distrace.camera import Camera
from distrace.render import Buffers, render

CENTRE, CORNER = (24, 24), (0, 0)


camera, seen = camera_and_buffers(48, 48)


def pictures(seen: Buffers) -> dict[str, np.ndarray]:
    return {
        "depth": shading.depth_picture(seen.depth),
        "normal": shading.normal_picture(seen.normal, seen.mask),
        "mask": shading.mask_picture(seen.mask),
        "comparison": shading.mask_comparison(seen.mask, seen.mask),
        "shaded": shading.shaded_picture(seen.normal, seen.mask, seen.rays.directions),
        "error": shading.error_picture(seen.depth - seen.depth, 0.1),
    }


@pytest.mark.parametrize("name", ["depth", "normal", "mask", "comparison", "shaded", "error"])
def test_the_background_is_white_and_the_sphere_is_not(seen: Buffers, name: str) -> None:
    picture = pictures(seen)[name]
    assert picture.shape == (48, 48, 3)
    assert picture.dtype == np.uint8
    assert (picture[~seen.mask.numpy()] == 255).all()
    assert (picture[seen.mask.numpy()].min(-1) < 240).all()


def test_arrays_and_tensors_give_the_same_pictures(seen: Buffers) -> None:
    normal, mask, directions = seen.normal.numpy(), seen.mask.numpy(), seen.rays.directions.numpy()
    given = pictures(seen)
    assert (shading.depth_picture(seen.depth.numpy()) == given["depth"]).all()
    assert (shading.shaded_picture(normal, mask, directions) == given["shaded"]).all()


def test_a_tensor_that_requires_grad_can_be_drawn(seen: Buffers) -> None:
    assert (shading.depth_picture(seen.depth.clone().requires_grad_()) == shading.depth_picture(seen.depth)).all()


def test_a_normal_along_each_world_axis_has_that_axis_colour() -> None:
    drawn = shading.normal_picture(torch.eye(3)[None], torch.ones(1, 3, dtype=torch.bool))
    assert drawn[0].tolist() == [[255, 128, 128], [128, 255, 128], [128, 128, 255]]


def test_with_a_pose_a_normal_that_faces_the_camera_is_blue_and_one_that_points_up_is_green(
    camera: Camera, seen: Buffers
) -> None:
    drawn = shading.normal_picture(seen.normal, seen.mask, camera.T_world_camera)
    assert np.abs(drawn[CENTRE].astype(int) - [128, 128, 255]).max() <= 6
    rows = np.nonzero(seen.mask[:, 24].numpy())[0]
    assert drawn[rows[0], 24, 1] > 230
    assert drawn[rows[-1], 24, 1] < 25


def test_near_is_brighter_than_far(seen: Buffers) -> None:
    drawn = shading.depth_picture(seen.depth).astype(int)
    edge = np.nonzero(seen.mask[24].numpy())[0][0]
    assert drawn[CENTRE].sum() > drawn[24, edge].sum() + 100


def test_one_range_gives_one_depth_one_colour_in_two_pictures() -> None:
    first, second = torch.tensor([[1.0, 2.0]]), torch.tensor([[2.0, 9.0]])
    near, far = shading.depth_range(first, second)
    assert (near, far) == (1.0, 9.0)
    drawn = shading.depth_picture(first, near, far), shading.depth_picture(second, near, far)
    assert (drawn[0][0, 1] == drawn[1][0, 0]).all()
    assert (shading.depth_picture(first)[0, 1] != shading.depth_picture(second)[0, 0]).any()


@pytest.mark.parametrize("nothing", [torch.inf, torch.nan])
def test_an_image_without_depth_is_white(nothing: float) -> None:
    assert (shading.depth_picture(torch.full((4, 5), nothing)) == 255).all()
    assert (shading.error_picture(torch.full((4, 5), nothing), 0.1) == 255).all()


def test_masks_agree_lack_and_exceed_in_three_colours() -> None:
    observed, rendered = torch.tensor([[True, True, False, False]]), torch.tensor([[True, False, True, False]])
    expected = [shading.AGREE, shading.MISSING, shading.EXTRA, shading.WHITE]
    assert [tuple(colour) for colour in shading.mask_comparison(observed, rendered)[0].tolist()] == expected
    assert len(set(expected)) == 4


def test_clay_is_lit_from_the_upper_left(seen: Buffers) -> None:
    drawn = shading.shaded_picture(seen.normal, seen.mask, seen.rays.directions).astype(int).sum(-1)
    assert drawn[16, 16] > drawn[32, 32] + 60


def test_clay_is_lit_where_the_camera_looks_straight_down() -> None:
    camera = Camera.orbit(0, 90, 4.0, height=48, width=48)
    with torch.no_grad():
        seen = render(BALL, camera)
    drawn = shading.shaded_picture(seen.normal, seen.mask, seen.rays.directions)
    assert 120 < drawn[CENTRE].mean() < 250


def test_an_error_is_blue_where_too_near_and_red_where_too_far_and_stops_at_the_limit() -> None:
    near, none, far, farther = shading.error_picture(torch.tensor([[-0.1, 0.0, 0.1, 0.7]]), 0.1)[0].astype(int)
    assert near[2] > near[0] + 100
    assert np.ptp(none) < 5
    assert far[0] > far[2] + 100
    assert (far == farther).all()


def test_means_are_of_light_and_not_of_the_values_of_a_picture() -> None:
    black_and_white = np.zeros((2, 2, 3), np.uint8)
    black_and_white[0] = 255
    mean = shading.mean_light(black_and_white, np.ones((2, 2), bool), 2, None)
    assert mean[0, 0, 0] == round(255 * 0.5 ** (1 / 2.2)) == 186


def test_a_background_lies_behind_what_the_mask_does_not_cover() -> None:
    red = np.full((2, 4, 3), (200, 0, 0), np.uint8)
    mask = np.array([[True, True, True, False], [True, True, False, False]])
    ((inside, quarter),) = shading.mean_light(red, mask, 2, None).tolist()
    assert inside == [200, 0, 0, 255]
    assert quarter == [200, 0, 0, 64], "transparency does not darken the colour"
    ((inside, quarter),) = shading.mean_light(red, mask, 2, (0, 0, 255)).tolist()
    assert inside == [200, 0, 0]
    assert quarter == [round(200 * 0.25 ** (1 / 2.2)), 0, round(255 * 0.75 ** (1 / 2.2))]


def test_one_sample_over_white_is_the_picture_itself(seen: Buffers) -> None:
    shaded = pictures(seen)["shaded"]
    assert (shading.mean_light(shaded, seen.mask, 1, shading.WHITE) == shaded).all()


def test_dots_lie_on_their_pixels_and_nowhere_else() -> None:
    depth = torch.full((100, 100), torch.inf)
    depth[20, 70] = 3.0
    drawn = shading.dots_picture(np.full((100, 100, 3), 255, np.uint8), depth)
    assert drawn.shape == (600, 600, 3)
    dark = np.argwhere((drawn < 250).any(-1)) / 6
    assert np.abs(dark.mean(0) - [20.5, 70.5]).max() < 0.2
    assert np.abs(dark - dark.mean(0)).max() < 2


def test_pictures_of_different_sizes_stand_in_cells_of_the_largest() -> None:
    small, large = np.zeros((2, 3, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)
    drawn = shading.grid([[small, large], [large]], gap=2)
    assert drawn.shape == (10, 12, 3)
    assert (drawn[:2, :3] == 0).all()
    assert (drawn[:4, 7:] == 0).all()
    assert (drawn[6:, :5] == 0).all()
    assert (drawn == 0).all(-1).sum() == 2 * 3 + 2 * 4 * 5
    assert shading.side_by_side([small, small], gap=1).shape == (2, 7, 3)


def test_a_grid_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="no picture"):
        shading.grid([])


def test_a_saved_picture_is_read_back_as_it_was(seen: Buffers, tmp_path: Path) -> None:
    drawn = shading.normal_picture(seen.normal, seen.mask)
    shading.save_png(tmp_path / "new" / "normal.png", drawn)
    assert (np.asarray(Image.open(tmp_path / "new" / "normal.png")) == drawn).all()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["normal.png"]
