"""Folders of photographs in our own layout, which layout is found, and what can be wrong with any of them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from photographed import (
    POINT,
    SIZES,
    WORLD,
    ball,
    cameras,
    cut,
    in_world,
    photographs,
    reads_back,
    refused,
    write_images,
    write_masks,
)
from PIL import Image

from distrace.data.photographs import Photograph, Photographs, load_photographs, notes, save_photographs
from distrace.data.unit_sphere import UnitSphere
from distrace.rays import meet_sphere

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"  # beside the repository, where there is one


def own(folder: Path, change: Callable[[dict], object] = lambda content: None) -> Path:
    """Our own layout, as a person would write it."""
    write_images(folder / "images")
    write_masks(folder / "masks")
    views = [
        {
            "image": f"images/view{k}.png",
            "mask": f"masks/view{k}.png",
            "intrinsics": camera.intrinsics.tolist(),
            "T_world_camera": camera.T_world_camera.tolist(),
        }
        for k, camera in enumerate(in_world())
    ]
    content = {"views": views, "unit_sphere": {"centre": [2, -3, 40], "radius": 5}}
    change(content)
    (folder / "views.json").write_text(json.dumps(content))
    return folder


def test_our_own_layout_is_read(tmp_path: Path) -> None:
    reads_back(own(tmp_path), "views.json")
    loaded = load_photographs(tmp_path)
    assert (loaded.unit_sphere.centre.tolist(), loaded.unit_sphere.radius) == ([2.0, -3.0, 40.0], 5.0)
    for view, camera in zip(loaded.views, cameras()):
        assert view.mask is not None
        assert torch.equal(view.mask, ball(camera))
        torch.testing.assert_close(view.camera.T_world_camera, camera.T_world_camera.float(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("masks", [True, False])
def test_photographs_are_read_as_they_were_saved(tmp_path: Path, masks: bool) -> None:
    views = photographs(masks)
    views = [replace(view, camera=replace(view.camera, intrinsics=view.camera.intrinsics.float())) for view in views]
    save_photographs(tmp_path, Photographs(tuple(views), WORLD, "views.json"))
    loaded = load_photographs(tmp_path)
    assert loaded.unit_sphere.radius == WORLD.radius
    assert torch.equal(loaded.unit_sphere.centre, WORLD.centre)
    for view, read in zip(views, loaded.views):
        assert read.name == view.name
        assert torch.equal(read.image, view.image)
        assert (read.mask is None) == (not masks)
        assert read.mask is None or torch.equal(read.mask, view.mask)
        assert torch.equal(read.camera.intrinsics, view.camera.intrinsics)
        pose = view.camera.T_world_camera.float()
        torch.testing.assert_close(read.camera.T_world_camera, pose, atol=1e-6, rtol=0)


def test_photographs_of_one_name_are_saved_side_by_side(tmp_path: Path) -> None:
    views = tuple(replace(view, name="same") for view in photographs())
    save_photographs(tmp_path, Photographs(views, WORLD, "COLMAP"))
    assert [view.name for view in load_photographs(tmp_path).views] == [f"00{k}_same" for k in range(4)]


def test_photographs_of_one_name_in_several_folders_are_told_apart(tmp_path: Path) -> None:
    def several(content: dict) -> None:
        for number, entry in enumerate(content["views"]):
            image = tmp_path / f"camera{number}" / "0000.png"
            image.parent.mkdir()
            (tmp_path / entry["image"]).rename(image)
            entry["image"] = str(image.relative_to(tmp_path))

    names = [view.name for view in load_photographs(own(tmp_path, several)).views]
    assert names == [f"00{k}_0000" for k in range(4)]


def test_without_a_unit_sphere_it_is_around_what_the_masks_show(tmp_path: Path) -> None:
    loaded = load_photographs(own(tmp_path, lambda content: content.pop("unit_sphere")))
    away = (loaded.unit_sphere.centre - WORLD.centre).norm().item()
    assert away < 0.25 * WORLD.radius
    assert 0.5 * WORLD.radius < loaded.unit_sphere.radius + away < 1.1 * WORLD.radius, "a ball of half the radius"


@pytest.mark.parametrize("factor", [1.0, 0.5, 0.3, 0.1])
def test_a_point_is_at_the_same_place_of_a_coarser_photograph(factor: float) -> None:
    for view in photographs():
        coarser = view.resized(factor)
        assert coarser.image.shape == (coarser.camera.height, coarser.camera.width, 3)
        assert coarser.mask is not None
        assert coarser.mask.shape == coarser.image.shape[:2]
        assert coarser.image.isfinite().all()
        pixel, _ = view.camera.project(POINT)
        torch.testing.assert_close(coarser.camera.project(POINT)[0], factor * pixel)


def test_coarser_pixels_are_means_of_areas_also_where_these_cut_pixels() -> None:
    view = photographs()[0]
    half = view.resized(0.5).image
    blocks = view.image.reshape(12, 2, 16, 2, 3).mean((1, 3))
    torch.testing.assert_close(half, blocks, atol=1e-6, rtol=0)
    ramp = (torch.arange(32) + 0.5).expand(24, 32)[..., None].expand(-1, -1, 3) / 32
    coarse = replace(view, image=ramp.contiguous()).resized(0.3)  # 9.6 columns, of which the last is cut off
    centres = coarse.camera.pixels()[0, :-1, 0].float() / 0.3 / 32
    torch.testing.assert_close(coarse.image[0, :-1, 0], centres, atol=1e-2, rtol=0)
    assert torch.equal(view.resized(1.0).image, view.image) or (view.resized(1.0).image - view.image).abs().max() < 1e-6
    with pytest.raises(ValueError, match=r"resized by 1\.5"):
        view.resized(1.5)


def changed(name: str, value: object) -> Callable[[dict], object]:
    """Of the third view."""
    return lambda content: content["views"][2].update({name: value})


POSE = np.eye(4).tolist()
WRONG = {
    "no image": (changed("image", "images/none.png"), ("views[2]", "image names images/none.png", "no such file")),
    "no word of it": (changed("image", None), ("views[2]", "image is None")),
    "no mask": (changed("mask", "masks/none.png"), ("views[2]", "mask names masks/none.png")),
    "outside": (changed("image", "../view2.png"), ("views[2]", "image names ../view2.png, which leaves")),
    "absolute": (changed("mask", "/etc/hostname"), ("views[2]", "mask names /etc/hostname, which leaves")),
    "drive": (changed("mask", "C:\\m.png"), ("views[2]", "mask names C:\\m.png, which leaves")),
    "NaN": (changed("intrinsics", [[float("nan")] * 3] * 3), ("views[2]", "intrinsics", "not finite")),
    "shape": (changed("T_world_camera", POSE[:3]), ("views[2]", "T_world_camera", "4 × 4", "[3, 4]")),
    "ragged": (changed("T_world_camera", [[1], [1, 2]]), ("views[2]", "T_world_camera")),
    "words": (changed("intrinsics", "wide"), ("views[2]", "intrinsics")),
    "scaled": (changed("T_world_camera", np.diag([2.0, 2, 2, 1]).tolist()), ("views[2]", "T_world_camera", "scale")),
    "no list": (lambda content: content.update(views={}), ("views.json: views is no list",)),
    "no objects": (lambda content: content.update(views=[1, 2]), ("views.json: views is no list of objects",)),
    "one view": (lambda content: content.update(views=content["views"][:1]), ("describes 1 view", "two are needed")),
    "sphere": (lambda content: content.update(unit_sphere=3), ("views.json: unit_sphere",)),
    "radius": (lambda content: content["unit_sphere"].update(radius=0), ("unit_sphere", "radius 0")),
    "centre": (lambda content: content["unit_sphere"].update(centre=[0, 0]), ("unit_sphere", "centre is [0, 0]")),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_told_in_one_sentence_with_file_and_field(tmp_path: Path, name: str) -> None:
    change, words = WRONG[name]
    refused(own(tmp_path, change), str(tmp_path), *words)


def test_sizes_that_differ_are_both_told(tmp_path: Path) -> None:
    own(tmp_path)
    Image.fromarray(np.zeros((8, 9), np.uint8)).save(tmp_path / "masks" / "view1.png")
    refused(tmp_path, "views[1]", "masks/view1.png has 8 × 9 pixels", "20 × 30")


def test_files_that_are_cut_off_are_told(tmp_path: Path) -> None:
    own(tmp_path)
    cut(tmp_path / "images" / "view1.png", 200)
    refused(tmp_path, "images/view1.png cannot be read")
    cut(tmp_path / "views.json", 200)
    refused(tmp_path, "views.json cannot be read as JSON")


def test_a_folder_that_is_none_or_empty_is_told_with_what_was_looked_for(tmp_path: Path) -> None:
    refused(tmp_path / "none", f"there is no folder {tmp_path / 'none'}")
    refused(tmp_path, str(tmp_path), "views.json", "transforms.json", "cameras_sphere.npz", "_par.txt", "sparse/0")


def test_views_that_look_wrong_are_noted() -> None:
    first, second, third, fourth = photographs()
    grey = replace(first, image=torch.full_like(first.image, 0.4))
    white = replace(second, image=torch.where(torch.rand(*SIZES[1], 1) < 0.05, second.image, 1.0))
    empty = replace(third, mask=torch.zeros_like(ball(third.camera)))
    inside = replace(fourth, camera=UnitSphere(torch.zeros(3).double(), 10.0).camera_to_unit(fourth.camera))
    assert notes(Photographs((first, second, third, fourth), WORLD, "")) == []
    found = notes(Photographs((grey, white, empty, inside), WORLD, ""))
    words = ("view0 is of one colour", "view1 is fully white", "view2 has a mask that marks no", "view3 was taken from")
    assert len(found) == 4
    assert all(sentence.startswith(word) for sentence, word in zip(found, words))


def test_masks_that_are_all_black_are_refused(tmp_path: Path) -> None:
    own(tmp_path)
    for path in (tmp_path / "masks").iterdir():
        Image.fromarray(np.zeros_like(np.array(Image.open(path)))).save(path)
    refused(tmp_path, str(tmp_path), "its 4 masks mark no pixel as object")


def temple() -> Path:
    return SHARED / "templeSparseRing"


def scan() -> Path:
    return SHARED / "dtu_scan24_quarter"


def all_see_the_sphere(views: tuple[Photograph, ...]) -> bool:
    middles = torch.tensor([meet_sphere(view.camera.rays()).near.isfinite().float().mean() for view in views])
    return bool((middles > 0.3).all())


@pytest.mark.skipif(not temple().is_dir(), reason="Middlebury's temple is not here")
def test_the_temple_lies_in_the_sphere_that_its_cameras_look_at() -> None:
    loaded = load_photographs(temple())
    assert (len(loaded.views), loaded.layout, notes(loaded)) == (16, "Middlebury", [])
    assert all_see_the_sphere(loaded.views)
    low, high = torch.tensor([[-0.073568, 0.021728, -0.012445], [0.028855, 0.181892, 0.062736]]).double()
    corners = torch.cartesian_prod(*torch.stack([low, high], dim=1))
    assert (loaded.unit_sphere.to_unit(corners).norm(dim=-1) < 1).all(), "the tight bounding box of its README"


@pytest.mark.skipif(not scan().is_dir(), reason="DTU's scan 24 is not here")
def test_what_lies_in_all_masks_of_a_scan_is_in_its_sphere() -> None:
    loaded = load_photographs(scan())
    assert (len(loaded.views), loaded.layout, notes(loaded)) == (49, "IDR", [])
    assert all_see_the_sphere(loaded.views)
    steps = torch.linspace(-1, 1, 25)
    places = torch.cartesian_prod(steps, steps, steps)
    places = places[places.norm(dim=-1) < 1]
    for view in loaded.views:
        assert view.mask is not None
        pixels, _ = view.camera.project(places)
        column, row = pixels.long().unbind(-1)
        seen = (pixels >= 0).all(-1) & (column < view.camera.width) & (row < view.camera.height)
        places = places[seen][view.mask[row[seen], column[seen]]]
    assert len(places) > 100
    for view in loaded.views:
        assert view.mask is not None
        column, row = view.camera.project(places.mean(0))[0].long().tolist()
        assert view.mask[row, column]
