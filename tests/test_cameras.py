"""`cameras`: photographs or a video to cameras, in a folder that the other commands read."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

import distrace.cli
from distrace.camera import Camera
from distrace.data.photographs import load_photographs
from distrace.data.picture_input import copied_photographs, sharpest_frames, sharpness
from distrace.data.structure_from_motion import MAX_EXHAUSTIVE, Picture, pairs, undistort, upright
from distrace.optional import MissingLibrary
from distrace.rays import meet_sphere
from experiments.tables.cameras import camera_errors

pycolmap = pytest.importorskip("pycolmap")

SIZE = (240, 320)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    def command(*arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", ["distrace", "cameras", *map(str, arguments)])
        distrace.cli.main()

    return command


@pytest.fixture
def refused(run: Callable[..., None], capsys: pytest.CaptureFixture) -> Callable[..., str]:
    """Runs a command that fails; returns its one sentence."""

    def failed(*arguments: object) -> str:
        with pytest.raises(SystemExit) as stop:
            run(*arguments)
        assert stop.value.code == 2
        error = capsys.readouterr().err
        assert error.startswith("distrace: ")
        assert error.count("\n") == 1
        return error

    return failed


def noise(seed: int, height: int = SIZE[0], width: int = SIZE[1]) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)


def write_noise(folder: Path, count: int) -> Path:
    folder.mkdir()
    for number in range(count):
        Image.fromarray(noise(number, 60, 80)).save(folder / f"{number}.png")
    return folder


def test_bad_input_is_one_sentence(refused: Callable[..., str], tmp_path: Path) -> None:
    out = ("--out", tmp_path / "out")
    assert "there is no folder or file" in refused(tmp_path / "missing", *out)
    (tmp_path / "empty").mkdir()
    assert "holds no PNG or JPEG photographs\n" in refused(tmp_path / "empty", *out)
    (tmp_path / "empty" / "IMG.HEIC").write_text("")
    assert "it holds .HEIC: convert these" in refused(tmp_path / "empty", *out)
    two = write_noise(tmp_path / "two", 2)
    assert "holds 2 photographs; at least 3 are needed" in refused(two, *out)
    (two / "2.png").write_text("no picture")
    assert "2.png cannot be read as a PNG or JPEG image" in refused(two, *out)
    (tmp_path / "text.mp4").write_text("no video")
    assert "text.mp4 is neither a folder of photographs nor a video" in refused(tmp_path / "text.mp4", *out)
    assert "--frames 2 was given" in refused(two, "--frames", 2, *out)
    assert "--max-size 8 was given" in refused(two, "--max-size", 8, *out)
    assert not (tmp_path / "out" / "result.json").exists()


def test_nothing_of_the_users_is_overwritten(refused: Callable[..., str], tmp_path: Path) -> None:
    photographs = write_noise(tmp_path / "images", 3)
    before = {path: path.read_bytes() for path in photographs.iterdir()}
    assert "images would be replaced" in refused(photographs, "--out", tmp_path)
    other = write_noise(tmp_path / "other", 3)
    assert "holds images/ that no run of" in refused(other, "--out", tmp_path)
    assert {path: path.read_bytes() for path in photographs.iterdir()} == before
    (tmp_path / "out" / "work").mkdir(parents=True)
    (tmp_path / "out" / "masks").mkdir()
    (tmp_path / "out" / "work" / "input.json").write_text("{}")
    assert "masks of other photographs" in refused(other, "--out", tmp_path / "out")


def test_photographs_that_share_nothing_are_refused_in_one_sentence(
    refused: Callable[..., str], tmp_path: Path
) -> None:
    assert "no two of the 4 photographs show" in refused(write_noise(tmp_path / "noise", 4), "--out", tmp_path / "out")


@pytest.mark.parametrize(("library", "extra"), [("pycolmap", "photos"), ("av", "movie")])
def test_a_missing_library_is_named_with_its_extra(
    library: str, extra: str, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / "clip.mp4").write_bytes(b"0")
    assert f"pip install 'distrace[{extra}]'" in refused(tmp_path / "clip.mp4", "--out", tmp_path / "out")
    with pytest.raises(MissingLibrary):
        list(sharpest_frames(tmp_path / "clip.mp4", 3)) if library == "av" else upright(None)


def write_video(path: Path, pictures: list[np.ndarray]) -> None:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def test_the_sharpest_frame_of_each_span_of_a_video_is_chosen(tmp_path: Path) -> None:
    sharp = np.repeat(noise(0, 64, 96)[..., :1], 3, -1)  # grey, as H.264 halves the resolution of colours
    blurred = gaussian_filter(sharp, (2, 2, 0))
    assert sharpness(sharp[..., 0].astype(np.float32)) > 10 * sharpness(blurred[..., 0].astype(np.float32))
    chosen = {2, 3, 7}
    write_video(tmp_path / "clip.mp4", [sharp if number in chosen else blurred for number in range(9)])
    found = dict(sharpest_frames(tmp_path / "clip.mp4", 3))
    assert set(found) == chosen
    assert np.abs(found[7].astype(float) - sharp).mean() < 0.5 * np.abs(blurred.astype(float) - sharp).mean()
    assert [number for number, _ in sharpest_frames(tmp_path / "clip.mp4", 60)] == list(range(9))


def test_copies_are_upright_and_no_larger_than_allowed(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # turned by 90°
    exif.get_ifd(0x8769)[0xA405] = 27
    Image.fromarray(noise(0, 40, 100)).save(tmp_path / "a photo.jpg", exif=exif)
    alpha = np.concatenate([noise(1, 40, 100), np.full((40, 100, 1), 255, np.uint8)], -1)
    Image.fromarray(alpha).save(tmp_path / "b.png")
    steps: list[int] = []
    paths = [tmp_path / "a photo.jpg", tmp_path / "b.png"]
    copies = copied_photographs(paths, tmp_path / "out", 50, lambda: steps.append(1))
    assert copies == [Picture("a_photo.jpg", 50, 20, 27.0), Picture("b.png", 20, 50)]
    for copy in copies:
        with Image.open(tmp_path / "out" / "images" / copy.name) as image:
            assert (image.height, image.width, image.mode) == (copy.height, copy.width, "RGB")
    assert [path.name for path in (tmp_path / "out" / "masks").iterdir()] == ["b.png"]
    assert len(steps) == 2


def test_all_pairs_of_few_photographs_and_neighbours_and_loops_of_many() -> None:
    few = [str(number) for number in range(10)]
    assert len(pairs(few)) == 45
    many = [str(number) for number in range(MAX_EXHAUSTIVE + 21)]
    found = set(pairs(many))
    assert {("0", "10"), ("0", "100"), ("37", "38")} <= found
    assert ("1", "99") not in found
    assert len(found) < len(many) ** 2 / 4


def model_of(cameras: list[Camera], points: np.ndarray) -> "pycolmap.Reconstruction":
    """A reconstruction in memory, with a little distortion."""
    model = pycolmap.Reconstruction()
    first = cameras[0]
    focal, centre = float(first.intrinsics[0, 0]), (first.width / 2, first.height / 2)
    parameters = [focal, *centre, 0.02]
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=first.width, height=first.height, params=parameters, camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for number, each in enumerate(cameras, 1):
        world_from_camera = pycolmap.Rigid3d(each.T_world_camera[:3].double().numpy())
        image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, world_from_camera.inverse())
    for point in points:
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    return model


def test_a_reconstruction_is_written_upright_and_read_back(tmp_path: Path) -> None:
    tilt = torch.tensor([[1.0, 0, 0, 5], [0, 0, -1, 6], [0, 1, 0, 7], [0, 0, 0, 1]])
    orbit = [Camera.orbit(azimuth, 20, 4, height=60, width=80) for azimuth in (0, 90, 180, 270)]
    tilted = [replace(each, T_world_camera=tilt @ each.T_world_camera) for each in orbit]
    model = model_of(tilted, np.random.default_rng(0).normal(size=(30, 3)))
    upright(model)
    for folder in ("copies", "masks"):
        (tmp_path / folder).mkdir()
        for number in range(1, 5):
            Image.fromarray(noise(number, 60, 80)).save(tmp_path / folder / f"{number}.png")
    out = tmp_path / "out"
    out.mkdir()
    for _ in range(2):
        undistort(model, tmp_path / "copies", out, tmp_path / "masks")
    assert {path.name for path in out.iterdir()} == {"images", "masks", "sparse"}
    views = load_photographs(out).views
    assert [view.name for view in views] == ["1", "2", "3", "4"]
    assert all(view.mask is not None for view in views)
    found = {view.name: view.source.camera for view in views if view.source}
    errors = camera_errors(found, {str(number): each for number, each in enumerate(orbit, 1)})
    assert errors.degrees.max() < 1e-3
    assert errors.percent.max() < 1e-3
    assert all(camera.T_world_camera[1, 1] < -0.9 for camera in found.values())  # y of an image points down


def textured_ball(camera: Camera) -> np.ndarray:
    """A photograph of a ball of radius 0.9, with a texture of several scales."""
    rays = camera.rays()
    distance = meet_sphere(rays, 0.9).near
    hit = distance.isfinite()
    points = (rays.origins + distance.where(hit, 0.0)[..., None] * rays.directions).double().numpy()
    grid = np.random.default_rng(7).random((24, 24, 24, 3))
    values = np.zeros((*points.shape[:-1], 3))
    for frequency in (6.0, 17.0, 45.0):
        for channel in range(3):
            places = np.moveaxis(frequency * points, -1, 0)
            values[..., channel] += map_coordinates(grid[..., channel], places, order=1, mode="grid-wrap") / 3
    return np.where(hit.numpy()[..., None], 255 * values, 0).round().astype(np.uint8)


@pytest.mark.slow
def test_the_cameras_of_rendered_photographs_are_found(
    run: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    given = {}
    (tmp_path / "photos").mkdir()
    for number in range(14):
        name = f"{number:02}"
        given[name] = Camera.orbit(
            12 * number, 15 + 10 * np.sin(number).item(), 3.2, height=SIZE[0], width=SIZE[1], dtype=torch.float64
        )
        Image.fromarray(textured_ball(given[name])).save(tmp_path / "photos" / f"{name}.png")
    out = tmp_path / "out"
    for _ in range(2):  # the second run takes features and matches from the first
        run(tmp_path / "photos", "--out", out)
        result = json.loads((out / "result.json").read_text())
        assert result["placed"] == result["photographs"] == 14
        assert result["reprojection_error"] < 1
        views = load_photographs(out).views
        errors = camera_errors({view.name: view.source.camera for view in views if view.source}, given)
        assert errors.degrees.max() < 1
        assert errors.percent.max() < 3
    printed = capsys.readouterr().out
    assert printed.count("continuing from the photographs and features") == 1
    assert f"next: distrace reconstruct {out}" in printed.replace("\n", "")
    for name in ("03", "07", "11"):
        given[name] = Camera.orbit(77, 15, 3.2, height=SIZE[0], width=SIZE[1], dtype=torch.float64)
    wrong = camera_errors({view.name: view.source.camera for view in views if view.source}, given)
    assert wrong.degrees.max() > 1
