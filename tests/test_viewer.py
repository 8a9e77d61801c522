"""The viewer: what it opens, what it draws, and its page in a real browser."""

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import distrace as dt
from distrace.camera import Camera
from distrace.checkpoints.codes import named_code
from distrace.cli.common import save_code
from distrace.data.cloud import Cloud
from distrace.data.observation import View, save_view
from distrace.data.saved_scan import read_scan, save_scan
from distrace.data.scan import canonical_scan
from distrace.fields import primitives
from distrace.pose import Similarity
from distrace.viewer.image import LAYERS, Image
from distrace.viewer.live import Shown
from distrace.viewer.results import open_scene
from distrace.viewer.scene import Scene

viser = pytest.importorskip("viser")
PORT = 18_080
CAMERA = Camera.orbit(30, 20, 4.97, height=48, width=64)


def test_bands_are_the_rows_of_the_whole_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("distrace.viewer.image.BAND", 640)
    sphere = primitives.sphere(0.5)
    banded = Shown(Scene("sphere", sphere)).image(CAMERA)
    assert len(banded.bands) == 5
    whole = Image([dt.render(sphere, CAMERA)])
    assert (banded.mask != whole.mask).sum() <= 1
    both = banded.mask & whole.mask
    assert_allclose(banded.depth[both], whole.depth[both], atol=1e-5)


@pytest.mark.parametrize("layer", LAYERS)
def test_each_layer_is_a_picture_of_the_size(layer: str) -> None:
    shown = Shown(Scene("sphere", primitives.sphere(0.5)), layer)
    picture, legend = shown.picture(shown.image(CAMERA))
    assert picture.shape == (48, 64, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 3
    assert (legend == "") == (layer == "shaded")


def test_light_falls_from_where_it_is() -> None:
    shown = Shown(Scene("sphere", primitives.sphere(0.5)), light=np.array([1.0, 0.0, 0.0]))
    picture, _ = shown.picture(shown.image(Camera.orbit(0, 0, 4.97, height=48, width=48)))
    assert picture[24, 29].sum() > picture[24, 19].sum() + 100


@pytest.mark.parametrize(("given", "shape"), [("1", 1), ("beige-sofa-2-seats", 0)])
def test_codes_by_number_and_name(given: str, shape: int) -> None:
    model = dt.load_model("sofas")
    assert named_code(model, given).equal(model.codes[shape])


def test_codes_that_are_none_end_in_a_sentence(tmp_path: Path) -> None:
    model = dt.load_model("sofas")
    np.save(tmp_path / "short.npy", np.zeros(3))
    for given, said in (("9999", "9999"), ("sofaa", "no shape"), (str(tmp_path / "short.npy"), "256 values")):
        with pytest.raises(ValueError, match=said):
            named_code(model, given)
    with pytest.raises(ValueError, match=r"absent\.npy"):
        named_code(model, str(tmp_path / "absent.npy"))


def test_a_scan_is_read_back(tmp_path: Path) -> None:
    sphere = dt.render(primitives.sphere(0.5), CAMERA)
    scan = canonical_scan(View(CAMERA, sphere.depth, sphere.mask))
    save_scan(tmp_path / "scan.npz", scan)
    again, (camera,) = read_scan(tmp_path / "scan.npz")
    assert again.points.equal(scan.points)
    assert again.free_until.equal(scan.free_until)
    assert again.noise == pytest.approx(scan.noise)
    assert camera.T_world_camera.equal(CAMERA.T_world_camera)
    assert (camera.height, camera.width) == (48, 64)
    (tmp_path / "wrong.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match="no scan"):
        read_scan(tmp_path / "wrong.npz")


def completion(folder: Path, place: Similarity) -> None:
    """Writes what `complete` writes of a sofa."""
    model = dt.load_model("sofas")
    save_code(folder, model.codes[3], place)
    points = dt.render(model.field(3), CAMERA).points.detach()
    save_scan(folder / "scan.npz", canonical_scan(Cloud(place.to_world(points))))
    (folder / "result.json").write_text(json.dumps({"model": "sofas"}))


def test_a_completion_opens_in_the_frame_of_its_object(tmp_path: Path) -> None:
    turn = dt.exp_se3(torch.tensor([0.0, 0.5, 0.0]), torch.zeros(3))[:3, :3]
    completion(tmp_path, Similarity(turn, torch.tensor([1.0, 2.0, 3.0]), torch.tensor(0.4)))
    scene = open_scene(str(tmp_path))
    assert scene.code is not None
    assert scene.points is not None
    assert scene.refit is not None
    assert float(scene.sdf(scene.points).abs().max()) < 1e-3, "the points lie on the shape"
    progress: list[int] = []
    code = scene.refit(scene.code, lambda done, total: progress.append(done))
    assert progress[-1] == len(progress)
    assert float(dt.load_model("sofas").field(code)(scene.points).abs().mean()) < 0.02


def test_a_pose_opens_with_its_camera(tmp_path: Path) -> None:
    model = dt.load_model("sofas")
    save_code(tmp_path, model.codes[0], Similarity.identity())
    sphere = dt.render(primitives.sphere(0.5), CAMERA)
    save_view(tmp_path / "posed.npz", View(CAMERA, sphere.depth, sphere.mask))
    (tmp_path / "result.json").write_text(json.dumps({"model": "sofas"}))
    scene = open_scene(str(tmp_path))
    assert len(scene.cameras) == 1
    assert scene.points is not None


def test_a_folder_without_a_shape_is_refused(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(ValueError, match="holds no shape"):
        open_scene(str(tmp_path))
    (tmp_path / "result.json").write_text("[")
    with pytest.raises(ValueError, match=r"result\.json"):
        open_scene(str(tmp_path))


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator["dt.viewer.viewer.Viewer"]:
    from distrace.viewer.viewer import Viewer

    completion(tmp_path, Similarity.identity())
    viewer = Viewer(open_scene(str(tmp_path)), tmp_path / "saved", PORT)
    yield viewer
    viewer.close()


def test_saves_what_is_shown_and_a_page_without_a_server(viewer, tmp_path: Path) -> None:
    assert viewer.address.startswith("http://127.0.0.1:")
    viewer.show(layer="depth")
    assert viewer.save(None) == ["mesh.ply", "code.npy"]
    assert np.load(tmp_path / "saved" / "code.npy").shape == (256,)
    viewer.save_page(tmp_path / "page.html")
    assert "<html" in (tmp_path / "page.html").read_text()[:2000].lower()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desktop", "phone"])
def test_the_page_shows_the_shape_and_asks_nobody_else(viewer, size: tuple[int, int]) -> None:
    api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no Chromium is installed")
    with api.sync_playwright() as playwright:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        requests: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        page.goto(viewer.address)
        wait_for(page, lambda: "pixels" in viewer.controls.status.content)
        page.wait_for_timeout(1000)
        pixels = screenshot(page)
        browser.close()
    dark = (pixels[: size[1] // 2].mean(-1) < 200).mean()
    assert dark > 0.02, "a sofa is in the upper half"
    own = ("http://127.0.0.1:", "ws://127.0.0.1:", "blob:http://127.0.0.1:", "data:")
    assert [url for url in requests if not url.startswith(own)] == []


def wait_for(page, is_done) -> None:
    """Lets the page work for at most a minute."""
    began = time.monotonic()
    while not is_done():
        assert time.monotonic() - began < 60
        page.wait_for_timeout(200)


def screenshot(page) -> np.ndarray:
    from io import BytesIO

    from PIL import Image as Picture

    return np.array(Picture.open(BytesIO(page.screenshot())).convert("RGB"))
