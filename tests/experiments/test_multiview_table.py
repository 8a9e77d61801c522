"""The table of clips: what is found in them, and how far off it is."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from test_fit_photos import ring
from test_multiview import model, save_views

from distrace.data.photographs import Photograph
from distrace.data.solid import Solid
from distrace.pose import Similarity
from distrace.shading import error_picture
from experiments.tables.clip_page import LIMIT, comparison, save_clip_page
from experiments.tables.multiview import (
    ClipResult,
    ClipTrial,
    clip_done,
    disturbed,
    multiview_rows,
    remaining_motion,
    settings_of,
    surface_of,
)

__all__ = ["model"]  # a fixture


def test_a_disturbed_place_is_off_by_what_is_said() -> None:
    for seed in range(4):
        step = disturbed(seed).step_from(Similarity.identity())
        assert math.degrees(step[:3].norm()) == pytest.approx(10, abs=0.01)
        assert float(step[3:6].norm()) == pytest.approx(0.1, abs=1e-5)
        assert abs(math.expm1(abs(float(step[6])))) == pytest.approx(0.1, abs=1e-5)


def test_the_remaining_motion_is_how_a_surface_was_moved() -> None:
    box = trimesh.creation.box([1.0, 0.6, 0.3])
    moved = Similarity.identity().moved(torch.tensor([0.0, 0.05, 0.0, 0.02, 0.0, 0.0, 0.04]))
    surface = box.copy().apply_transform(moved.T_world_object.numpy())
    degrees, *others = remaining_motion(surface, box)
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

    for module in ("multiview", "clip_page"):
        monkeypatch.setattr(f"experiments.tables.{module}.true_solid", lambda *given: Solid(ball, ball))
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
