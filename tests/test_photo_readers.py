"""The layouts of other tools: each written by the test from known cameras, read back, and refused where it is wrong."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from photographed import (
    SIZES,
    WORLD,
    ball,
    cameras,
    colours,
    cut,
    in_world,
    reads_back,
    refused,
    write_images,
    write_masks,
)
from PIL import Image

from distrace.camera import Camera
from distrace.data.photo_readers.idr import decomposed
from distrace.data.photo_readers.transforms import save_transforms
from distrace.data.photograph import Source
from distrace.data.photographs import load_photographs, notes
from distrace.errors import DoubtfulResult

OPENGL = np.diag([1.0, -1, -1, 1])


def frames(folder: Path, change: Callable[[dict], object] = lambda content: None) -> Path:
    """transforms.json with everything given for each frame."""
    write_images(folder / "images", ".png")
    names = ("fl_x", "fl_y", "cx", "cy", "h", "w")
    entries = []
    for k, camera in enumerate(in_world()):
        focal_x, focal_y, middle = *camera.intrinsics.diagonal()[:2].tolist(), camera.intrinsics[:2, 2].tolist()
        values = (focal_x, focal_y, *middle, camera.height, camera.width)
        pose = (camera.T_world_camera.numpy() @ OPENGL).tolist()
        entries.append(dict(zip(names, values)) | {"file_path": f"images/view{k}.png", "transform_matrix": pose})
    content = {"camera_model": "OPENCV", "k1": 0, "p2": 0.0, "frames": entries}
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def angles(folder: Path) -> Path:
    """transforms_train.json of NeRF: one angle, names without suffix, cameras of equal sizes and central points."""
    (folder / "train").mkdir()
    entries = []
    for k in range(4):
        camera = angled(k)
        rgba = np.dstack([colours(camera, k), np.where(ball(camera).numpy(), 255, 0).astype(np.uint8)])
        Image.fromarray(rgba).save(folder / "train" / f"r_{k}.png")
        pose = (camera.T_world_camera.numpy() @ OPENGL).tolist()
        entries.append({"file_path": f"./train/r_{k}", "transform_matrix": pose})
    content = {"camera_angle_x": 2 * math.atan(16 / 40), "frames": entries}
    (folder / "transforms_train.json").write_text(json.dumps(content))
    return folder


def angled(k: int) -> Camera:
    return Camera.orbit(90 * k, 20 * k - 30, 3, height=24, width=32, focal_px=40.0, dtype=torch.float64)


def test_transforms_with_intrinsics_for_each_frame_are_read(tmp_path: Path) -> None:
    reads_back(frames(tmp_path), "transforms.json")


def sources_of(folder: Path) -> dict[str, Source]:
    return {view.name: view.source for view in load_photographs(folder).views if view.source is not None}


def test_saved_transforms_have_cameras_to_the_last_digit(tmp_path: Path) -> None:
    given = frames(tmp_path / "photographs")
    save_transforms(tmp_path / "out", sources_of(given))
    before = json.loads((given / "transforms.json").read_text())["frames"]
    after = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert after == [{**old, "file_path": f"images/view{k}.png"} for k, old in enumerate(before)]


@pytest.mark.parametrize("masks", ["alpha", "files"])
def test_saved_transforms_are_read_back_with_their_images_and_masks(tmp_path: Path, masks: str) -> None:
    given = tmp_path / "photographs"
    given.mkdir()
    if masks == "alpha":
        angles(given)
    else:
        write_masks(given / "masks")
        frames(given, with_masks)
    save_transforms(tmp_path / "out", sources_of(given))
    same_photographs(given, tmp_path / "out")


def same_photographs(first: Path, second: Path) -> None:
    for before, after in zip(load_photographs(first).views, load_photographs(second).views, strict=True):
        assert after.name == before.name
        assert torch.equal(after.image, before.image)
        assert torch.equal(after.known_mask, before.known_mask)
        assert torch.equal(after.camera.intrinsics, before.camera.intrinsics)
        torch.testing.assert_close(after.camera.T_world_camera, before.camera.T_world_camera)


def test_saving_transforms_beside_their_photographs_changes_no_file(tmp_path: Path) -> None:
    write_masks(tmp_path / "masks")
    frames(tmp_path, with_masks)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.png")}
    save_transforms(tmp_path, sources_of(tmp_path))
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.png")} == before
    assert all(view.mask is not None for view in load_photographs(tmp_path).views)


def test_saved_photographs_of_one_name_stay_apart(tmp_path: Path) -> None:
    given = frames(tmp_path / "photographs")
    content = json.loads((given / "transforms.json").read_text())
    for k, entry in enumerate(content["frames"]):
        (given / str(k)).mkdir()
        shutil.move(given / entry["file_path"], given / f"{k}/photograph.png")
        entry["file_path"] = f"{k}/photograph.png"
    (given / "transforms.json").write_text(json.dumps(content))
    save_transforms(tmp_path / "out", sources_of(given))
    for k, view in enumerate(load_photographs(tmp_path / "out").views):
        np.testing.assert_array_equal((view.image * 255).round().byte().numpy(), colours(cameras()[k], k))


def test_terms_and_flags_that_say_nothing_are_no_obstacle(tmp_path: Path) -> None:
    def zero(content: dict) -> None:
        content.update(is_fisheye=False, camera_model=None, distortion_params=[0, 0.0, 0, 0], ftheta_p0=0)

    reads_back(frames(tmp_path, zero), "transforms.json")


def test_transforms_with_one_angle_are_read_and_alpha_is_the_mask(tmp_path: Path) -> None:
    loaded = load_photographs(angles(tmp_path))
    assert loaded.layout == "transforms_train.json"
    for k, view in enumerate(loaded.views):
        camera = loaded.unit_sphere.camera_to_world(view.camera)
        torch.testing.assert_close(camera.rays().directions, angled(k).rays().directions.float(), atol=1e-5, rtol=0)
        torch.testing.assert_close(camera.rays().origins, angled(k).rays().origins.float(), atol=1e-4, rtol=0)
        assert view.mask is not None
        assert torch.equal(view.mask, ball(angled(k)))


def with_masks(content: dict) -> None:
    for k, entry in enumerate(content["frames"]):
        entry["mask_path"] = f"masks/view{k}.png"


def test_what_is_told_for_all_frames_holds_for_each_and_masks_are_read(tmp_path: Path) -> None:
    def common(content: dict) -> None:
        content["frames"] = content["frames"][::2]  # of one size
        for entry in content["frames"]:
            for name in ("fl_x", "fl_y", "cx", "cy", "h", "w"):
                content[name] = entry.pop(name)
            entry["mask_path"] = entry["file_path"].replace("images", "masks")

    write_masks(tmp_path / "masks")
    loaded = load_photographs(frames(tmp_path, common))
    assert [view.camera.intrinsics[0, 0].item() for view in loaded.views] == [32.0, 32.0]
    for view, camera in zip(loaded.views, cameras()[::2]):
        assert view.mask is not None
        assert torch.equal(view.mask, ball(camera))


def frame(**values: object) -> Callable[[dict], object]:
    return lambda content: content["frames"][1].update(values)


SCALED = np.diag([3.0, 3, 3, 1]).tolist()
FRAMES = {
    "distorted": (frame(k1=0.1), ("frames[1]", "k1 is 0.1", "undistort")),
    "all distorted": (lambda content: content.update(p1=-0.01), ("frames[0]", "p1 is -0.01", "undistort")),
    "fisheye": (
        lambda content: content.update(camera_model="OPENCV_FISHEYE"),
        ("camera_model", "FISHEYE", "undistort"),
    ),
    "a fisheye's flag": (frame(is_fisheye=True), ("frames[1]", "is_fisheye is True", "undistort")),
    "equirectangular": (frame(camera_model="EQUIRECTANGULAR"), ("frames[1]", "EQUIRECTANGULAR", "pinhole")),
    "orthographic": (frame(camera_model="orthographic"), ("frames[1]", "'orthographic'", "pinhole")),
    "a panorama's flag": (
        lambda content: content.update(equirectangular=True),
        ("frames[0]", "equirectangular is True"),
    ),
    "a list of terms": (frame(distortion_params=[0, 0, 0.2, 0]), ("frames[1]", "distortion_params is [0, 0, 0.2, 0]")),
    "F-theta": (lambda content: content.update(ftheta_p1=0.003, ftheta_p0=0), ("frames[0]", "ftheta_p1 is 0.003")),
    "words as terms": (frame(distortion_params="none"), ("frames[1]", "distortion_params is 'none'")),
    "twice as large": (frame(fl_x=60, fl_y=60, cx=30, cy=20), ("frames[1]", "are for an image of 40 × 60 pixels")),
    "no image": (frame(file_path="images/none"), ("frames[1]", "file_path names images/none")),
    "outside": (frame(file_path="images/../../x.png"), ("frames[1]", "file_path", "leaves")),
    "no mask": (frame(mask_path="masks/1.png"), ("frames[1]", "mask_path names masks/1.png")),
    "other size": (frame(w=31), ("frames[1]", "view1.png has 20 × 30 pixels", "20 × 31")),
    "no focal": (lambda content: [content["frames"][1].pop(name) for name in ("fl_x", "fl_y")], ("frames[1]", "fl_x")),
    "negative": (frame(fl_x=-3), ("frames[1]", "fl_x is -3")),
    "a word": (frame(cx="middle"), ("frames[1]", "cx is 'middle'")),
    "NaN": (frame(transform_matrix=[[math.nan] * 4] * 4), ("frames[1]", "transform_matrix", "not finite")),
    "scaled": (frame(transform_matrix=SCALED), ("frames[1].transform_matrix", "no rotation")),
    "no pose": (lambda content: content["frames"][1].pop("transform_matrix"), ("frames[1]", "transform_matrix")),
    "no frames": (lambda content: content.pop("frames"), ("transforms.json: frames is no list",)),
}


@pytest.mark.parametrize("name", FRAMES)
def test_what_is_wrong_with_transforms_is_told(tmp_path: Path, name: str) -> None:
    change, words = FRAMES[name]
    refused(frames(tmp_path, change), "transforms.json", *words)


def model(
    folder: Path, kind: str, place: str = "sparse/0", name: str = "PINHOLE", points: int = 60, images: int = 4
) -> Path:
    """A model of COLMAP, whose images see all points, written by COLMAP's own library."""
    import pycolmap

    write_images(folder / "images")
    built = pycolmap.Reconstruction()
    drawn = np.random.default_rng(0).normal(size=(points, 3)) * 0.3
    for k, camera in enumerate(in_world()[:images], 1):
        focal_x, focal_y, middle = *camera.intrinsics.diagonal()[:2].tolist(), camera.intrinsics[:2, 2].tolist()
        values = {"PINHOLE": [focal_x, focal_y, *middle], "SIMPLE_RADIAL": [focal_x, *middle, 0.1]}[name]
        sensor = pycolmap.Camera(model=name, width=camera.width, height=camera.height, params=values, camera_id=k)
        built.add_camera_with_trivial_rig(sensor)
        inverse = pycolmap.Rigid3d(camera.T_world_camera.numpy()[:3]).inverse()
        image = pycolmap.Image(f"view{k - 1}.png", np.zeros((points, 2)), k, k)
        built.add_image_with_trivial_frame(image, inverse)
    for k, point in enumerate(WORLD.to_world(torch.from_numpy(drawn)).numpy()):
        built.add_point3D(point, pycolmap.Track([pycolmap.TrackElement(image, k) for image in range(1, images + 1)]))
    (folder / place).mkdir(parents=True, exist_ok=True)
    (built.write_text if kind == "text" else built.write_binary)(folder / place)
    return folder


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_models_of_colmap_are_read_and_their_points_tell_the_sphere(tmp_path: Path, kind: str, place: str) -> None:
    reads_back(model(tmp_path, kind, place), "COLMAP")
    unit_sphere = load_photographs(tmp_path).unit_sphere
    assert (unit_sphere.centre - WORLD.centre).norm() < 0.2 * WORLD.radius
    assert 0.5 < unit_sphere.radius / WORLD.radius < 1.2


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_of_several_models_the_one_with_most_images_is_read(tmp_path: Path, kind: str) -> None:
    model(tmp_path, kind, "sparse/0", images=2)
    model(tmp_path, kind, "sparse/1", images=3)
    with pytest.warns(DoubtfulResult, match=r"sparse/1, the largest of 2 models, has 3 of 4 photographs; the others"):
        assert [view.name for view in load_photographs(tmp_path).views] == ["view0", "view1", "view2"]
    model(tmp_path, kind, "sparse/10")
    reads_back(tmp_path, "COLMAP")


def test_images_that_colmap_did_not_place_are_counted(tmp_path: Path) -> None:
    with pytest.warns(DoubtfulResult, match=r"sparse has 2 of 4 photographs; the others are left out"):
        assert len(load_photographs(model(tmp_path, "binary", "sparse", images=2)).views) == 2


def test_lines_of_images_without_the_empty_ones_are_read(tmp_path: Path) -> None:
    path = model(tmp_path, "text", points=0) / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if line.strip()))
    assert len(path.read_text().splitlines()) < len(lines)
    reads_back(tmp_path, "COLMAP")


def test_models_of_few_points_are_placed_by_their_views(tmp_path: Path) -> None:
    unit_sphere = load_photographs(model(tmp_path, "text", points=3)).unit_sphere
    assert (unit_sphere.centre - WORLD.centre).norm() < 0.2 * WORLD.radius


def test_older_models_without_rigs_are_read(tmp_path: Path) -> None:
    model(tmp_path, "binary")
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "sparse/0" / name).unlink()
    reads_back(tmp_path, "COLMAP")


def test_what_is_wrong_with_a_model_is_told(tmp_path: Path) -> None:
    refused(model(tmp_path / "radial", "text", name="SIMPLE_RADIAL"), "view0.png", "SIMPLE_RADIAL", "image_undistorter")
    model(tmp_path / "image", "text")
    (tmp_path / "image/images/view2.png").unlink()
    refused(tmp_path / "image", "sparse/0: image view2.png", "there is no view2.png in")
    model(tmp_path / "size", "text")
    Image.fromarray(np.zeros((5, 6, 3), np.uint8)).save(tmp_path / "size/images/view2.png")
    refused(tmp_path / "size", "image view2.png", "5 × 6 pixels", "24 × 32")
    model(tmp_path / "mask", "text")
    write_masks(tmp_path / "mask/masks")
    assert all(view.mask is not None for view in load_photographs(tmp_path / "mask").views)
    (tmp_path / "mask/masks/view3.png").unlink()
    refused(tmp_path / "mask", "image view3.png", "neither view3.png.png nor view3.png")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_models_that_are_cut_off_or_longer_are_told(tmp_path: Path, name: str) -> None:
    path = model(tmp_path, "binary") / "sparse/0" / name
    whole = path.read_bytes()
    for content in (b"", whole[:4], whole[:37], whole[:-1], whole + b"0", b"\xff" * 300):
        path.write_bytes(content)
        refused(tmp_path, f"sparse/0/{name} is cut off or damaged")


def test_a_model_without_its_images_is_told(tmp_path: Path) -> None:
    model(tmp_path, "text")
    (tmp_path / "sparse/0/images.txt").unlink()
    refused(tmp_path, "sparse/0", "images")
    shutil.copy(tmp_path / "sparse/0/cameras.txt", tmp_path / "sparse/0/images.txt")
    refused(tmp_path, "sparse/0")


def scale() -> np.ndarray:
    matrix = np.diag([WORLD.radius] * 3 + [1.0])
    matrix[:3, 3] = WORLD.centre.numpy()
    return matrix


def projections(folder: Path, **changed: object) -> Path:
    """cameras_sphere.npz, whose matrices are known but for a factor."""
    write_images(folder / "image")
    matrices = {}
    for k, camera in enumerate(in_world()):
        whole = np.eye(4)
        whole[:3] = camera.intrinsics.numpy() @ np.linalg.inv(camera.T_world_camera.numpy())[:3] * (-1) ** k * (k + 1)
        matrices |= {f"world_mat_{k}": whole, f"scale_mat_{k}": scale(), f"world_mat_inv_{k}": np.linalg.inv(whole)}
    matrices = {name: value for name, value in (matrices | changed).items() if value is not None}
    np.savez(folder / "cameras_sphere.npz", **matrices)
    return folder


def test_projections_of_idr_are_read(tmp_path: Path) -> None:
    reads_back(projections(tmp_path), "IDR")
    unit_sphere = load_photographs(tmp_path).unit_sphere
    assert torch.equal(unit_sphere.centre, WORLD.centre)
    assert unit_sphere.radius == WORLD.radius


def test_a_unit_sphere_smaller_than_the_object_is_noted(tmp_path: Path) -> None:
    """The object is a ball of half the radius of the sphere that is right."""
    for name, factor, noted in (("right", 1.0, False), ("touching", 0.55, False), ("half as large", 0.25, True)):
        smaller = scale() @ np.diag([factor, factor, factor, 1])
        folder = projections(tmp_path / name, **{f"scale_mat_{k}": smaller for k in range(4)})
        write_masks(folder / "mask")
        found = notes(load_photographs(folder))
        assert any("of the object in the masks lies beyond the unit sphere" in note for note in found) == noted, found


def test_masks_of_idr_go_with_the_images_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    projections(tmp_path)
    write_masks(tmp_path / "mask")
    for k, number in enumerate(("8", "9", "10", "11")):
        (tmp_path / f"image/view{k}.png").rename(tmp_path / f"image/{number}.png")
    loaded = load_photographs(tmp_path)
    assert [view.name for view in loaded.views] == ["8", "9", "10", "11"]
    for view, camera in zip(loaded.views, cameras()):
        assert view.mask is not None
        assert torch.equal(view.mask, ball(camera))
        torch.testing.assert_close(view.camera.T_world_camera, camera.T_world_camera.float(), atol=1e-5, rtol=0)


def test_a_projection_is_made_of_what_it_is_decomposed_into() -> None:
    drawn = np.random.default_rng(3).normal(size=(3, 4))
    intrinsics, pose = decomposed(drawn)
    again = intrinsics @ np.linalg.inv(pose)[:3]
    np.testing.assert_allclose(again / again[2, 3], drawn / drawn[2, 3], atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert (np.diag(intrinsics) > 0).all()


PROJECTIONS = {
    "one missing": ({"world_mat_2": None}, ("3 matrices world_mat_N", "4 images")),
    "another name": ({"world_mat_2": None, "world_mat_7": np.eye(4)}, ("world_mat_2",)),
    "no scale": ({"scale_mat_1": None}, ("scale_mat_1",)),
    "NaN": ({"world_mat_1": np.full((4, 4), np.nan)}, ("world_mat_1", "not finite")),
    "flat": ({"world_mat_1": np.zeros((4, 4))}, ("world_mat_1", "no inverse")),
    "shape": ({"world_mat_1": np.eye(3)}, ("world_mat_1", "[3, 3]")),
    "stretched": ({f"scale_mat_{k}": np.diag([1.0, 2, 1, 1]) for k in range(4)}, ("scale_mat_0", "scale and shift")),
    "differing": ({"scale_mat_3": np.eye(4)}, ("scale_mat_3", "scale_mat_0")),
}


@pytest.mark.parametrize("name", PROJECTIONS)
def test_what_is_wrong_with_projections_is_told(tmp_path: Path, name: str) -> None:
    changed, words = PROJECTIONS[name]
    refused(projections(tmp_path, **changed), "cameras_sphere.npz", *words)


def test_masks_of_another_number_and_files_that_are_cut_off_are_told(tmp_path: Path) -> None:
    projections(tmp_path)
    write_masks(tmp_path / "mask")
    (tmp_path / "mask/view3.png").unlink()
    refused(tmp_path, "mask holds 3 masks", "image holds 4 images")
    cut(tmp_path / "cameras_sphere.npz", 500)
    refused(tmp_path, "cameras_sphere.npz cannot be read")


def lines(folder: Path, change: Callable[[list[str]], object] = lambda rows: None) -> Path:
    """A par file, in whose pixels 0 is the middle of the first."""
    write_images(folder)
    rows = [str(len(SIZES))]
    for k, camera in enumerate(in_world()):
        inverse = np.linalg.inv(camera.T_world_camera.numpy())
        values = [*camera.intrinsics.numpy().ravel(), *inverse[:3, :3].ravel(), *inverse[:3, 3]]
        rows.append(" ".join([f"view{k}.png", *(f"{value:.17g}" for value in values)]))
    change(rows)
    (folder / "ball_par.txt").write_text("\n".join(rows) + "\n")
    return folder


def test_lines_of_middlebury_are_read_half_a_pixel_on(tmp_path: Path) -> None:
    reads_back(lines(tmp_path), "Middlebury", shift=0.5)


def replaced(old: str, new: str) -> Callable[[list[str]], object]:
    """In the line of the second view."""
    return lambda rows: rows.__setitem__(2, rows[2].replace(old, new, 1))


LINES = {
    "one missing": (lambda rows: rows.pop(), ("line 1", "4 images, and 3 follow")),
    "no number": (lambda rows: rows.pop(0), ("does not begin with the number",)),
    "no image": (replaced("view1", "none"), ("line 3", "imgname names none.png")),
    "outside": (replaced("view1", "../view1"), ("line 3", "imgname", "leaves")),
    "a word": (replaced(" 31 ", " x "), ("line 3",)),
    "too few": (replaced(" 31 ", " "), ("line 3", "20 words; 21 numbers are needed")),
    "NaN": (replaced(" 31 ", " nan "), ("line 3", "not finite")),
}


@pytest.mark.parametrize("name", LINES)
def test_what_is_wrong_with_lines_is_told(tmp_path: Path, name: str) -> None:
    change, words = LINES[name]
    refused(lines(tmp_path, change), "ball_par.txt", *words)


def test_two_par_files_are_told(tmp_path: Path) -> None:
    lines(tmp_path)
    (tmp_path / "other_par.txt").write_text("0\n")
    refused(tmp_path, "ball_par.txt, other_par.txt")
