"""Movies: read back they are what was rendered, and an interrupted one was never there."""

from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from distrace import movie
from distrace.camera import Camera
from distrace.fields.base import Counted
from distrace.fields.primitives import box, sphere
from distrace.movie import filmed, save_gif, save_mp4, turntable
from distrace.render import STRATEGIES, render

SAVERS = {"mp4": save_mp4, "gif": save_gif}


def camera(azimuth: float = 30.0) -> Camera:
    return Camera.orbit(azimuth, 20, 3.0, focal_px=30, height=24, width=24)


def pictures(height: int, width: int, frames: int = 3) -> np.ndarray:
    """A grey bar on white that goes to the right."""
    images = np.full((frames, height, width, 3), 255, np.uint8)
    for k in range(frames):
        images[k, :, 2 + 3 * k : 6 + 3 * k] = (140, 130, 120)
    return images


def seen_in_mp4(path: Path) -> np.ndarray:
    with av.open(str(path)) as opened:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)])


def seen_in_gif(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)])


def difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs(first.astype(int) - second)


def test_a_turntable_is_a_turn_in_even_steps_from_the_given_camera() -> None:
    for k, turned in enumerate(turntable(camera(), 5)):
        orbited = camera(30 + 72 * k)
        assert torch.allclose(turned.T_world_camera, orbited.T_world_camera, atol=1e-6)
        assert torch.equal(turned.intrinsics, orbited.intrinsics)
    assert torch.equal(turntable(camera(), 5)[0].T_world_camera, camera().T_world_camera)


@pytest.mark.parametrize("frames", [1, 0, -3])
def test_a_turn_of_fewer_than_two_frames_is_refused(frames: int) -> None:
    with pytest.raises(ValueError, match=f"orbit of {frames} frames .* at least 2"):
        turntable(camera(), frames)


def test_filmed_views_are_those_rendered_alone_and_learn_the_field_once() -> None:
    counted = Counted(box(torch.tensor([0.6, 0.3, 0.4])))
    with torch.no_grad():
        views = list(filmed(counted, turntable(camera(), 4)))
        alone = [render(counted.sdf, each) for each in turntable(camera(), 4)]
    assert counted.evaluations == sum(view.trace.total_evaluations for view in views)
    assert views[0].trace.setup_evaluations > 0
    assert [view.trace.setup_evaluations for view in views[1:]] == [0, 0, 0]
    for view, single in zip(views, alone):
        assert torch.equal(view.depth, single.depth)


def test_a_march_films_and_another_radius_does() -> None:
    with torch.no_grad():
        views = [*filmed(sphere(1.5), turntable(camera(), 2), radius=2.0, config=STRATEGIES["coarse_to_fine"])]
        views += filmed(sphere(1.5), turntable(camera(), 2), radius=2.0)
    assert all(view.mask.any() for view in views)


@pytest.mark.parametrize(("height", "width"), [(16, 16), (33, 20), (20, 33), (33, 33)])
def test_an_mp4_is_what_browsers_play_and_shows_the_pictures(height: int, width: int, tmp_path: Path) -> None:
    shown, path = pictures(height, width), tmp_path / "movie.mp4"
    save_mp4(path, shown)
    seen = seen_in_mp4(path)
    assert seen.shape == (3, height + height % 2, width + width % 2, 3)
    assert difference(seen[:, :height, :width], shown).mean() < 4
    assert (seen[:, height:] > 240).all(), "what makes a side even is white"
    assert (seen[:, :, width:] > 240).all()
    with av.open(str(path)) as opened:
        stream = opened.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert stream.duration is not None
        assert stream.duration * stream.time_base == 3 * movie.FRAME
    content = path.read_bytes()
    assert content.find(b"moov") < content.find(b"mdat"), "a browser starts before it has all of the file"


def test_the_colours_of_an_mp4_are_those_of_the_pictures(tmp_path: Path) -> None:
    plain = np.broadcast_to(np.array([150, 90, 60], np.uint8), (3, 32, 32, 3))
    save_mp4(tmp_path / "movie.mp4", plain)
    assert difference(seen_in_mp4(tmp_path / "movie.mp4"), plain).max() <= 3


def test_a_gif_shows_the_pictures_over_and_over(tmp_path: Path) -> None:
    shown = pictures(33, 20)
    save_gif(tmp_path / "movie.gif", shown)
    assert np.array_equal(seen_in_gif(tmp_path / "movie.gif"), shown)
    with Image.open(tmp_path / "movie.gif") as image:
        assert (image.n_frames, image.size) == (3, (20, 33))
        assert (image.info["loop"], image.info["duration"]) == (0, 80)


def test_a_gif_has_one_palette_for_all_colours_of_all_pictures(tmp_path: Path) -> None:
    ramps = np.zeros((4, 16, 64, 3), np.uint8)
    for k in range(4):
        ramps[k] = (np.linspace(60 * k, 60 * k + 60, 64)[:, None] * [1, 0.9, 0.8]).astype(np.uint8)
    save_gif(tmp_path / "movie.gif", ramps)
    assert difference(seen_in_gif(tmp_path / "movie.gif"), ramps).max() <= 6


def test_pictures_that_do_not_change_are_shown_for_longer(tmp_path: Path) -> None:
    still = np.repeat(pictures(16, 16, frames=1), 3, axis=0)
    for name, save in SAVERS.items():
        save(tmp_path / f"still.{name}", still)
    assert len(seen_in_mp4(tmp_path / "still.mp4")) == 3
    with Image.open(tmp_path / "still.gif") as image:
        assert image.info["duration"] == 240


@pytest.mark.parametrize("name", SAVERS)
def test_no_pictures_are_no_movie(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no picture was given"):
        SAVERS[name](tmp_path / "movie", pictures(16, 16)[:0])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", SAVERS)
def test_an_interrupted_movie_leaves_the_one_before_as_it_was(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "movie"
    SAVERS[name](path, pictures(16, 16))
    before, calls = path.read_bytes(), []

    def interrupted(*arguments: object, **options: object) -> object:
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return original(*arguments, **options)

    if name == "mp4":
        original = av.VideoFrame.from_ndarray
        monkeypatch.setattr(av, "VideoFrame", SimpleNamespace(from_ndarray=interrupted))
    else:
        original = Image.Image.crop
        monkeypatch.setattr(Image.Image, "crop", interrupted)
    with pytest.raises(KeyboardInterrupt):
        SAVERS[name](path, pictures(16, 16, frames=4))
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["movie"], "nor is any part left beside it"
