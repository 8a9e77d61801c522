"""The viewer: what it opens, what it draws, and its page in a real browser."""

import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import distrace as dt
from distrace.camera import Camera
from distrace.checkpoints.codes import save_code
from distrace.cli.view import check_page
from distrace.data.cloud import Cloud
from distrace.data.observation import View, save_view
from distrace.data.saved_scan import save_scan
from distrace.data.scan import canonical_scan
from distrace.fields import primitives
from distrace.pose import Similarity
from distrace.viewer.image import LAYERS, Image
from distrace.viewer.live import LiveView, Shown, TracedField, picture_heights
from distrace.viewer.results import open_scene
from distrace.viewer.scene import Scene, field_scene

if TYPE_CHECKING:
    from distrace.viewer.viewer import Viewer

PORT = 18_080
CAMERA = Camera.orbit(30, 20, 4.97, height=48, width=64)


def test_bands_are_the_rows_of_the_whole_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("distrace.viewer.live.BAND", 640)
    sphere = primitives.sphere(0.5)
    banded = TracedField(Scene("sphere", sphere)).image(CAMERA)
    assert len(banded.bands) == 5
    whole = Image([dt.render(sphere, CAMERA)])
    assert (banded.mask != whole.mask).sum() <= 1
    both = banded.mask & whole.mask
    assert_allclose(banded.depth[both], whole.depth[both], atol=1e-5)


@pytest.mark.parametrize("layer", LAYERS)
def test_each_layer_is_a_picture_of_the_size(layer: str) -> None:
    shown = Shown(TracedField(Scene("sphere", primitives.sphere(0.5))), layer)
    picture, legend = shown.picture(shown.field.image(CAMERA))
    assert picture.shape == (48, 64, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 3
    assert (legend == "") == (layer == "shaded")


def test_light_falls_from_where_it_is() -> None:
    shown = Shown(TracedField(Scene("sphere", primitives.sphere(0.5))), light=np.array([1.0, 0.0, 0.0]))
    picture, _ = shown.picture(shown.field.image(Camera.orbit(0, 0, 4.97, height=48, width=48)))
    assert picture[24, 29].sum() > picture[24, 19].sum() + 100


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
    progress: list[tuple[int, int]] = []
    code, verdict = scene.refit(scene.code, lambda done, total: progress.append((done, total)))
    assert progress == [(done, len(progress)) for done in range(1, len(progress) + 1)]
    assert verdict.startswith(("trusted", "doubtful", "failed"))
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
    (tmp_path / "result.json").write_text('{"model": "sofas"}')  # as that of `render`
    with pytest.raises(ValueError, match="holds no shape; give the model, sofas, with --code, or what complete, pose"):
        open_scene(str(tmp_path))
    (tmp_path / "result.json").write_text("[")
    with pytest.raises(ValueError, match=r"result\.json"):
        open_scene(str(tmp_path))
    (tmp_path / "result.json").write_text("{}")
    np.save(tmp_path / "code.npy", np.zeros(256))
    with pytest.raises(ValueError, match="names no model"):
        open_scene(str(tmp_path))
    with pytest.raises(ValueError, match="--code 3"):
        open_scene(str(tmp_path), "3")


class Ball(torch.nn.Module):
    """A field whose radius requires grad."""

    def __init__(self) -> None:
        super().__init__()
        self.radius = torch.nn.Parameter(torch.tensor(3.0))

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return points.norm(dim=-1) - self.radius


def test_a_field_of_any_radius_is_shown_in_the_unit_sphere() -> None:
    scene = field_scene(Ball(), radius=6.0)
    image = TracedField(scene).image(CAMERA)
    assert image.depth[image.mask].min() == pytest.approx(4.97 - 0.5, abs=1e-2)
    assert float(scene.place.scale) == 6.0
    with pytest.raises(ValueError, match="radius of 0"):
        field_scene(Ball(), radius=0)


class PretendedClient:
    """A browser with a camera, which keeps the pictures it was sent."""

    def __init__(self) -> None:
        self.client_id = 0
        self.pictures: list[np.ndarray | None] = []
        self.scene = self.camera = self
        self.position = np.array([0.0, 0.0, 4.97])
        self.wxyz = np.array([0.0, 1.0, 0.0, 0.0])  # looks along −z, y up
        self.fov = 0.52
        self.aspect = 1.0
        self.image_height = 128

    def on_update(self, callback: Callable[[object], None]) -> None:
        self.moved = callback

    def set_background_image(self, picture: np.ndarray | None, **_: object) -> None:
        self.pictures.append(picture)


def wait_until(is_done: Callable[[], bool]) -> None:
    began = time.monotonic()
    while not is_done():
        assert time.monotonic() - began < 60
        time.sleep(0.02)


def test_pictures_get_finer_and_other_layers_are_not_traced_again() -> None:
    client = PretendedClient()
    shown = Shown(TracedField(field_scene(Ball(), radius=6.0)))
    reports: list[str] = []
    view = LiveView(client, lambda: shown, reports.append)  # pyright: ignore[reportArgumentType]
    wait_until(lambda: len(client.pictures) == 2)
    pictures = [picture for picture in client.pictures if picture is not None]
    assert [len(picture) for picture in pictures] == [64, 128]
    assert (pictures[-1][64, 64] < 240).all(), "the ball is in the middle"
    assert (pictures[-1][2, 2] == 255).all()
    counts = len(reports)
    wait_until(lambda: not view.changed.is_set())
    shown = Shown(shown.field, "depth")
    view.changed.set()
    wait_until(lambda: len(reports) > counts)
    assert [None if picture is None else len(picture) for picture in client.pictures] == [64, 128, 128]
    assert " s  " not in reports[-1], "no time was spent on tracing"
    shown = Shown(shown.field, "depth", mesh=True)
    view.changed.set()
    wait_until(lambda: client.pictures[-1] is None)
    view.close()


def test_the_last_picture_is_as_sharp_as_the_browser() -> None:
    assert picture_heights(900) == [64, 128, 512, 900]
    assert picture_heights(600) == [64, 128, 600]
    assert picture_heights(10) == [64]
    assert picture_heights(4000)[-1] == 1024


@pytest.mark.parametrize("aspect", [0.2, 0.46, 0.75, 1.0, 2.0])
def test_the_first_camera_sees_the_whole_unit_sphere(aspect: float) -> None:
    pytest.importorskip("viser")
    from distrace.viewer.viewer import EYE, FIELD_OF_VIEW, framing_position

    position = framing_position(aspect)
    half_across = np.arctan(np.tan(FIELD_OF_VIEW / 2) * min(aspect, 1))
    assert np.arcsin(1 / np.linalg.norm(position)) < half_across
    assert_allclose(np.cross(position, EYE), 0, atol=1e-9)
    assert (position == EYE) == (aspect >= 1)


def test_a_field_that_raises_becomes_a_sentence() -> None:
    def wrong(points: torch.Tensor) -> torch.Tensor:
        raise KeyError("no such layer")

    reports: list[str] = []
    shown = Shown(TracedField(Scene("wrong", wrong)))
    view = LiveView(PretendedClient(), lambda: shown, reports.append)  # pyright: ignore[reportArgumentType]
    wait_until(lambda: bool(reports))
    view.close()
    assert reports == ["This view cannot be traced: 'no such layer'"]


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator["Viewer"]:
    pytest.importorskip("viser")
    from distrace.viewer.viewer import Viewer

    completion(tmp_path, Similarity.identity())
    viewer = Viewer(open_scene(str(tmp_path)), tmp_path / "saved", PORT)
    yield viewer
    viewer.close()


@pytest.mark.slow
def test_saves_what_is_shown_and_says_what_it_does(viewer, tmp_path: Path) -> None:
    assert viewer.address.startswith("http://127.0.0.1:")
    viewer.set_layer("depth")
    assert viewer.save(None) == tmp_path / "saved" / "saved-1"
    assert viewer.save(None) == tmp_path / "saved" / "saved-2", "nothing is written over"
    again = open_scene(str(tmp_path / "saved" / "saved-1"))
    assert again.code is not None
    assert again.code.equal(viewer.scene.code)
    steps: list[str] = []
    viewer.save(None, steps.append)
    assert steps == ["extracting the mesh, 256 cells along each side …"]


def test_the_last_choice_is_what_stays(viewer: "Viewer") -> None:
    controls = viewer.controls
    event = SimpleNamespace(client=object())
    model = viewer.scene.model
    assert model is not None
    for shape in (5, 6, 7):
        controls._by_hand(event, lambda shape=shape: controls._set_code(model.codes[shape], str(shape)))  # pyright: ignore[reportArgumentType]
    controls._by_hand(SimpleNamespace(client=None), lambda: pytest.fail("moved by the program"))  # pyright: ignore[reportArgumentType]
    controls.worker.submit(lambda: None).result(60)
    assert viewer.scene.code is not None
    assert viewer.scene.code.equal(model.codes[7])
    assert controls.sliders[0].value == pytest.approx(float(controls.prior.coordinates(model.codes[7])[0]), abs=0.01)
    controls._submit(lambda: {}["absent"])
    controls.worker.submit(lambda: None).result(60)
    assert controls.message.content == "That failed: 'absent'"


def test_the_mesh_takes_the_place_of_the_picture(viewer: "Viewer") -> None:
    controls = viewer.controls
    scene = viewer.server.scene
    for layer in ("mesh", "depth", "mesh", "normal"):
        controls.layer.value = layer
        controls.worker.submit(lambda: None).result(60)
        mesh = scene.get_handle_by_name("/mesh")
        assert mesh is not None
        assert mesh.visible == viewer.shown.mesh == (layer == "mesh")
    assert viewer.shown.layer == "normal"


@contextmanager
def browser_page(size: tuple[int, int]) -> Iterator[Any]:
    """Opens a page of Chromium, of a width and a height; skips the test where there is no Chromium."""
    api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no Chromium is installed")
    with api.sync_playwright() as playwright:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        yield browser.new_page(viewport={"width": size[0], "height": size[1]})
        browser.close()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desktop", "phone"])
def test_a_page_without_a_server_shows_the_whole_shape(viewer, size: tuple[int, int], tmp_path: Path) -> None:
    viewer.save_page(tmp_path / "page.html")
    with browser_page(size) as page:
        page.goto((tmp_path / "page.html").as_uri())
        page.wait_for_timeout(8000)
        pixels = screenshot(page)
    row = (pixels[size[1] // 3 :].mean(-1) < 200).any(axis=0)
    assert row.mean() > 0.2, "a sofa is seen"
    assert not row[:4].any()
    assert not row[-4:].any()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desktop", "phone"])
def test_the_page_shows_the_shape_and_asks_nobody_else(viewer, size: tuple[int, int]) -> None:
    with browser_page(size) as page:
        requests: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        page.goto(viewer.address)
        wait_for(page, lambda: "pixels" in viewer.controls.status.content)
        page.wait_for_timeout(1000)
        pixels = screenshot(page)
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


@pytest.mark.parametrize("name", ["page", "page.png", "file/page.html"])
def test_a_page_that_cannot_be_written_is_refused_at_once(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=rf"^--save \S+{name} "):
        check_page(tmp_path / name)
