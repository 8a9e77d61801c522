"""Synthetic clips: what they are made from, the folder they lie in, and that Mitsuba's camera is ours to the pixel."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

from distrace.camera import Camera
from distrace.data.mesh_files import load_soup
from distrace.data.patches import Patch, load_patches, placed
from distrace.data.solid import Solid, load_solid, turned
from experiments.__main__ import main
from experiments.clips import clip, mitsuba_scene
from experiments.clips.clutter import NEAREST, boxes, sky
from experiments.clips.mottled_patches import has_images, mottled_patch
from experiments.clips.solid_texture import mottled, value_noise
from experiments.datasets.solids import observe

RED, GREEN, BLUE, WHITE = (220, 30, 30), (30, 200, 30), (30, 30, 220), (230, 230, 230)
TURN = 40.0
SPLIT = "name,split,design,turn,path,creator,licence\n"
Command = Callable[..., None]


def lopsided() -> trimesh.Trimesh:
    """A slab with a horn on one corner and a nose in front: no mirror image of it is itself."""
    parts = [trimesh.creation.box((1.0, 0.3, 0.6)) for _ in range(3)]
    parts[1].apply_scale((0.15, 2.5, 0.2)).apply_translation((0.4, 0.5, -0.2))
    parts[2].apply_scale((0.2, 0.5, 1.0)).apply_translation((-0.3, 0.0, 0.5))
    return trimesh.util.concatenate(parts)


def stored(folder: Path, image: bool = True) -> Path:
    """The same as an OBJ; its image is red and green above, blue and white below."""
    mesh = lopsided()
    mesh.unmerge_vertices()
    mesh.apply_translation((5.0, -2.0, 1.0))
    flat = mesh.vertices[:, :2] - mesh.bounds[0, :2]
    quarters = np.kron(np.array([[RED, GREEN], [BLUE, WHITE]], np.uint8), np.ones((4, 4, 1), np.uint8))
    material = SimpleMaterial(image=Image.fromarray(quarters)) if image else SimpleMaterial(diffuse=(200, 80, 20))
    mesh.visual = TextureVisuals(uv=flat / np.ptp(mesh.vertices[:, :2], axis=0), material=material)
    path = folder / "thing" / "thing.obj"
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)
    return path


@pytest.fixture
def library() -> None:
    pytest.importorskip("mitsuba")


@pytest.fixture
def world(tmp_path: Path) -> Path:
    """A catalogue of one shape, and a split that holds it out."""
    stored(tmp_path / "meshes")
    rows = f"thing,test,thing,{TURN},thing/thing.obj,Ann,CC0-1.0\nother,train,other,0,other.obj,Bob,CC0-1.0\n"
    (tmp_path / "things.csv").write_text(SPLIT + rows)
    return tmp_path


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, world: Path) -> Command:
    def command(*arguments: object) -> None:
        common = ["--split", world / "things.csv", "--meshes", world / "meshes", "--out", world / "clip"]
        monkeypatch.setattr(sys, "argv", ["experiments", "clip", *map(str, [*arguments, *common])])
        main()

    return command


TINY = ("--frames", 3, "--size", 24, "--samples", 2)


def corners(patches: list[Patch]) -> np.ndarray:
    return np.concatenate([patch.corners for patch in patches]).reshape(-1, 3)


def test_patches_lie_where_the_solid_does(tmp_path: Path) -> None:
    path = stored(tmp_path)
    solid = turned(load_solid(path), TURN)
    points = corners(placed(load_patches(path), TURN))
    assert solid.distance(points).max() < 1e-6, "parts of faces may be buried, none lies outside"
    np.testing.assert_allclose([points.min(0), points.max(0)], solid.surface.bounds, atol=1e-6)


def test_a_loose_sheet_is_left_out(tmp_path: Path) -> None:
    path = stored(tmp_path)
    sheet = np.array([[[0, 0, 0], [1, 0, 0], [0, 0, 1.0]]]) * 0.1 + load_soup(path).bounds.mean(0) + (0, 0.4, 0.2)
    patches = [*load_patches(path), Patch(sheet, np.zeros((1, 3, 2)), np.ones((1, 3, 3)))]
    assert len(placed(patches, 0.0)) == len(patches) - 1


def test_only_images_with_something_on_them_count(tmp_path: Path) -> None:
    assert has_images(load_patches(stored(tmp_path / "own")))
    plain = load_patches(stored(tmp_path / "plain", image=False))
    assert not has_images(plain)
    np.testing.assert_allclose(plain[0].colours[0, 0], np.array([200, 80, 20]) / 255, atol=0.01)


def test_a_painted_patch_covers_the_same_surface_in_colours_that_vary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("experiments.clips.mottled_patches.EDGE", 0.05)
    (patch,) = placed(load_patches(stored(tmp_path, image=False)), 0.0)
    fine = mottled_patch(patch, 3)
    assert fine.area == pytest.approx(patch.area)
    assert np.linalg.norm(fine.corners - np.roll(fine.corners, 1, axis=1), axis=-1).max() <= 0.05 + 1e-9
    assert fine.colours.std((0, 1)).min() > 0.05


def test_noise_is_the_same_for_the_same_place_and_seed_and_has_no_jumps() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    noise = value_noise(points, 1)
    np.testing.assert_array_equal(noise, value_noise(points, 1))
    assert 0.5 < noise.std() < 1.5
    assert np.abs(value_noise(points + 1e-5, 1) - noise).max() < 0.01
    assert np.corrcoef(noise, value_noise(points, 2))[0, 1] == pytest.approx(0, abs=0.1)
    black = mottled(points, np.zeros((4000, 3)), 1)
    assert black.std() > 0.05, "black takes the noise, too"


def test_clutter_lies_beyond_the_orbit_and_is_the_same_for_the_same_seed() -> None:
    assert np.linalg.norm(boxes(4).corners, axis=-1).min() > clip.DISTANCE + 0.1 < NEAREST
    np.testing.assert_array_equal(boxes(4).corners, boxes(4).corners)
    assert not np.array_equal(sky(4), sky(5))


def scene(patches: list[Patch], background: str = "plain") -> mitsuba_scene.Stage:
    return mitsuba_scene.staged(patches, background, 0)


@pytest.fixture
def solid(tmp_path: Path) -> Solid:
    return turned(load_solid(stored(tmp_path)), TURN)


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 10), (75, 35), (200, -20)])
@pytest.mark.usefixtures("library")
def test_the_true_mask_and_depth_are_those_of_embree(
    solid: Solid, tmp_path: Path, azimuth: int, elevation: int
) -> None:
    camera = Camera.orbit(azimuth, elevation, clip.DISTANCE, height=256, width=256, dtype=torch.float64)
    mask, depth = mitsuba_scene.truth(scene(placed(load_patches(stored(tmp_path)), TURN)), camera)
    single = Camera(camera.intrinsics.float(), camera.T_world_camera.float(), 256, 256)
    view = observe(solid, single)
    seen = view.seen.numpy()
    both = mask & seen
    assert both.sum() / (mask | seen).sum() > 0.99
    assert np.isinf(depth[~mask]).all()
    assert np.quantile(np.abs(depth[both] - view.depth.numpy()[both]), 0.98) < 1e-4


@pytest.mark.usefixtures("library")
def test_an_image_lies_on_the_mesh_the_right_way_up(tmp_path: Path) -> None:
    """From the front, its left is at the left, and its upper half above; x and y of the mesh are u and v."""
    camera = Camera.orbit(0, 0, clip.DISTANCE, height=32, width=32, dtype=torch.float64)
    stage = scene(placed(load_patches(stored(tmp_path)), 0.0))
    mask, _ = mitsuba_scene.truth(stage, camera)
    image = mitsuba_scene.photograph(stage, camera, 16, 0).astype(float)
    rows, columns = np.nonzero(mask)
    low, left, right = rows.max() - 1, columns.min() + 1, columns.max() - 1
    assert image[low, left].argmax() == 2, "blue"
    assert np.ptp(image[low, right]) < 40, "white"
    assert image[rows.min() + 1, columns[rows == rows.min() + 1].mean().astype(int)].argmax() == 1, "green"


@pytest.mark.usefixtures("library")
def test_a_clip_has_the_files_that_readers_expect(run: Command, world: Path) -> None:
    run("thing", *TINY, "--background", "cluttered")
    folder = world / "clip"
    views = json.loads((folder / "views.json").read_text())
    assert views["unit_sphere"] == {"centre": [0, 0, 0], "radius": 1.0}
    assert [view["image"] for view in views["views"]] == ["images/000.png", "images/001.png", "images/002.png"]
    for frame, view in enumerate(views["views"]):
        assert set(view) == {"image", "intrinsics", "T_world_camera"}
        camera = Camera.from_matrices(
            torch.tensor(view["intrinsics"]), torch.tensor(view["T_world_camera"]), height=24, width=24
        )
        image, mask = (np.array(Image.open(folder / path)) for path in (view["image"], f"truth/masks/{frame:03d}.png"))
        assert image.shape == (24, 24, 3)
        assert camera.T_world_camera[:3, 3].norm().item() == pytest.approx(clip.DISTANCE, rel=1e-5)
        assert set(np.unique(mask)) == {0, 255}
        assert np.isfinite(np.load(folder / f"truth/depth/{frame:03d}.npy")).sum() == (mask == 255).sum()
    described = json.loads((folder / "clip.json").read_text())
    expected = {"shape": "thing", "texture": "own", "background": "cluttered", "frames": 3, "size": 24}
    assert expected.items() <= described.items()
    assert {"split", "creator", "licence", "mitsuba", "seed", "samples", "mesh"} <= set(described)


def stamps(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*.[pjn]*") if path.name != "result.json"}


@pytest.mark.usefixtures("library")
def test_a_second_run_renders_nothing_and_a_stopped_one_goes_on(run: Command, world: Path) -> None:
    run("thing", *TINY)
    before = stamps(world / "clip")
    lost = world / "clip/images/001.png"
    pixels = np.array(Image.open(lost))
    run("thing", *TINY)
    assert stamps(world / "clip") == before
    assert json.loads((world / "clip/result.json").read_text())["rendered"] == 0
    lost.unlink()
    run("thing", *TINY)
    np.testing.assert_array_equal(np.array(Image.open(lost)), pixels)
    assert json.loads((world / "clip/result.json").read_text())["rendered"] == 1


@pytest.mark.usefixtures("library")
def test_another_clip_in_the_folder_is_left_alone(
    run: Command, world: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("thing", *TINY)
    before = stamps(world / "clip")
    with pytest.raises(SystemExit):
        run("thing", "--frames", 3, "--size", 32, "--samples", 2)
    assert "holds another clip (size 24); choose another --out" in capsys.readouterr().err
    assert stamps(world / "clip") == before


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("no-such", *TINY), "no-such is no held-out shape of .*things.csv; they are thing"),
        (("other", *TINY), "other is no held-out shape .* they are thing"),
        (("thing", "--frames", 1), "--frames 1 was given; a clip has at least 2"),
        (("thing", "--size", 15), "--size 15 was given; at least 16 pixels"),
        (("thing", "--samples", 0), "--samples 0 was given"),
        (("thing", "--background", "forest"), "forest"),
    ],
)
def test_bad_input_ends_in_one_sentence(
    run: Command, world: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[object, ...], why: str
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run(*arguments)
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    assert re.search(why, said), said
    assert not (world / "clip").exists()


def test_without_mitsuba_the_sentence_says_how_to_get_it(
    run: Command, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(SystemExit, match="2"):
        run("thing", *TINY)
    assert "`pip install 'distrace[clips]'` installs it" in capsys.readouterr().err
