"""From a folder of photographs to a mesh by the command, and the table of clips, with painted bumpy balls."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from bumpy import bumpy_balls
from test_fit_photos import GREY, TRUE, paint, ring

from distrace.boundary import shade
from distrace.camera import Camera
from distrace.checkpoint import Model, save_model
from distrace.cli import main
from distrace.data.photographs import Photograph, Photographs, Placement, save_photographs
from distrace.data.solid import Solid
from distrace.photographs.fit_photos import KNOWN_PLACE
from distrace.pose import Similarity
from distrace.render import render
from distrace.shading import error_picture
from experiments.tables.clip_page import LIMIT, comparison, save_clip_page
from experiments.tables.multiview import (
    ClipResult,
    ClipTrial,
    clip_done,
    disturbed,
    left_over,
    multiview_rows,
    settings_of,
    surface_of,
)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    random = torch.Generator().manual_seed(2)
    codes = torch.cat([0.3 * torch.randn(4, 4, generator=random), torch.zeros(1, 4)])
    save_model(tmp_path / "balls", Model("balls", bumpy_balls(), codes, tuple("abcde")), torch.float32)
    return tmp_path / "balls"


@torch.no_grad()
def save_views(folder: Path, cameras: list[Camera]) -> None:
    field = bumpy_balls().field(TRUE)
    images = [shade(render(field, camera), paint, GREY) for camera in cameras]
    views = [
        Photograph(f"{k:02}", camera, image) for k, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]
    save_photographs(folder, Photographs(tuple(views), Placement(torch.tensor([3.0, 0, 0]).double(), 2.0), "ours"))


def test_a_folder_of_photographs_becomes_a_mesh_in_its_own_world(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_views(tmp_path / "views", ring(6, 40))
    monkeypatch.setattr("distrace.cli.multiview.KNOWN_PLACE", replace(KNOWN_PLACE, iterations=2, levels=(0.5, 1.0)))
    for name in ("SHOWN", "FRAMES"):
        monkeypatch.setattr(f"distrace.pages.views_page.{name}", 2)
    out = tmp_path / "out"
    given = [str(model), str(tmp_path / "views"), "--out", str(out), "--fixed"]
    given += ["--starts", "1", "--rays", "500", "--resolution", "40"]
    monkeypatch.setattr("sys.argv", ["distrace", "multiview", *given])
    main()
    wanted = {"mesh.ply", "code.npy", "report.html", "forming.gif", "result.json"}
    assert {path.name for path in out.iterdir()} == wanted
    result = json.loads((out / "result.json").read_text())
    assert result["unit_sphere"] == {"centre": [3.0, 0.0, 0.0], "radius": 2.0}
    assert np.allclose(result["T_unit_object"], np.eye(4))
    assert np.load(out / "code.npy").shape == (4,)
    mesh = trimesh.load(out / "mesh.ply")
    assert mesh.centroid == pytest.approx([3.0, 0, 0], abs=0.8)
    assert 1.0 < mesh.extents.max() < 4.0


def test_a_folder_without_views_ends_in_one_sentence(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.setattr(
        "sys.argv", ["distrace", "multiview", str(model), str(tmp_path / "empty"), "--out", str(tmp_path)]
    )
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert "holds no photographs with cameras" in error
    assert error.count("\n") == 1


def test_a_disturbed_place_is_off_by_what_is_said() -> None:
    for seed in range(4):
        step = disturbed(seed).step_from(Similarity.identity())
        assert math.degrees(step[:3].norm()) == pytest.approx(10, abs=0.01)
        assert float(step[3:6].norm()) == pytest.approx(0.1, abs=1e-5)
        assert abs(math.expm1(abs(float(step[6])))) == pytest.approx(0.1, abs=1e-5)


def test_what_is_left_over_is_how_a_surface_was_moved() -> None:
    box = trimesh.creation.box([1.0, 0.6, 0.3])
    moved = Similarity.identity().moved(torch.tensor([0.0, 0.05, 0.0, 0.02, 0.0, 0.0, 0.04]))
    surface = box.copy().apply_transform(moved.T_world_object.numpy())
    degrees, *others = left_over(surface, box)
    assert degrees == pytest.approx(math.degrees(0.05), abs=0.3)  # 2.9, by points that are drawn
    assert others == pytest.approx([0.02, 0.04], abs=0.005)


def test_rows_are_medians_of_each_class_background_and_method() -> None:
    def result(method: str, chamfer: float, degrees: float) -> ClipResult:
        return ClipResult("sofas", "s", "plain", "own", method, chamfer, 2 * chamfer, 1.0, degrees, 0.0, 0.0, [])

    found = multiview_rows(
        [result("ours", 1, 0), result("ours", 3, 0), result("ours, moved", 1, 0.5), result("ours, moved", 1, 4)]
    )
    assert [(row["method"], row["chamfer"], row["n"]) for row in found] == [("ours", 6, 2), ("ours, moved", 3, 2)]
    assert found[1]["recovered"] == 0.5
    assert "recovered" not in found[0]


def test_a_clips_page_draws_meshes_and_points_and_their_distances_from_the_truth() -> None:
    frames = [Photograph(f"{k:02}", camera, torch.full((40, 40, 3), 0.5)) for k, camera in enumerate(ring(6, 40))]
    ball, larger = (trimesh.creation.icosphere(subdivisions=3, radius=radius) for radius in (0.5, 0.5 + LIMIT / 2))
    surfaces = {"ours": ball, "large": larger, "stereo": np.asarray(ball.vertices)}
    picture = comparison(frames, surfaces, Solid(ball, ball))
    cell = 48  # 40 pixels and a gap
    assert picture.shape == (4 * cell - 8, 4 * cell - 8, 3), "two eyes; shapes and distances; the truth and three"
    middles = picture[20::cell, 20::cell]
    assert (middles[1, 0] == 255).all(), "nothing below the truth"
    right, half = (error_picture(np.array([[apart]]), LIMIT)[0, 0] for apart in (0.0, LIMIT / 2))
    np.testing.assert_allclose(middles[1, 1], right, atol=3)
    np.testing.assert_allclose(middles[1, 2], half, atol=4)
    assert (picture[:40, 3 * cell :] == 96).any(), "points are dots"


def test_a_trial_leaves_its_surface_and_is_done_again_without_it(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stereo leaves points; and the page shows what was found."""
    clip = {"split": "s.csv", "shape": "ball", "background": "plain", "texture": "own"}
    clip |= {"seed": 0, "frames": 6, "size": 40, "samples": 1}
    save_views(tmp_path / "clip", ring(6, 40))
    (tmp_path / "clip" / "clip.json").write_text(json.dumps(clip))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    calls: list[str] = []

    def found(views: object) -> np.ndarray:
        calls.append("stereo")
        return np.asarray(ball.vertices) * 1.05

    for module in ("multiview_table", "clip_page"):
        monkeypatch.setattr(f"distrace.evaluation.{module}.true_solid", lambda *given: Solid(ball, ball))
    monkeypatch.setattr("experiments.tables.multiview.stereo_points", found)
    trial = ClipTrial(tmp_path / "clip", "stereo", tmp_path, tmp_path / "out", str(model))
    result = clip_done(trial)
    assert clip_done(trial) == result
    assert len(calls) == 1
    np.testing.assert_allclose(surface_of(trial), np.asarray(ball.vertices) * 1.05, atol=1e-5)
    save_clip_page(tmp_path / "pages", tmp_path / "clip", [trial], tmp_path)
    assert {path.name for path in (tmp_path / "pages").iterdir()} == {"ball_plain.html", "ball_plain.png"}
    page = (tmp_path / "pages" / "ball_plain.html").read_text()
    assert "<h1>ball from a clip</h1>" in page
    assert page.count("<img") == 6 + 1, "frames, and the comparison"
    trial.file(".ply").unlink()
    clip_done(trial)
    assert len(calls) == 2


def test_unknown_methods_are_refused() -> None:
    with pytest.raises(ValueError, match="no method 'guess'"):
        settings_of("guess")
