"""From a folder of photographs to a mesh by the command, with painted bumpy balls."""

import json
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
from distrace.checkpoints.model import Model, save_model
from distrace.cli import main
from distrace.data.photographs import Photograph, Photographs, UnitSphere, load_photographs, save_photographs
from distrace.photos.fit_photos import KNOWN_PLACE
from distrace.render import render


@pytest.fixture
def model(tmp_path: Path) -> Path:
    random = torch.Generator().manual_seed(2)
    codes = torch.cat([0.3 * torch.randn(4, 4, generator=random), torch.zeros(1, 4)])
    save_model(tmp_path / "balls", Model("balls", bumpy_balls(0.4), codes, tuple("abcde")), torch.float32)
    return tmp_path / "balls"


@torch.no_grad()
def save_views(folder: Path, cameras: list[Camera]) -> None:
    field = bumpy_balls(0.4).field(TRUE)
    images = [shade(render(field, camera), paint, GREY) for camera in cameras]
    views = [
        Photograph(f"{k:02}", camera, image) for k, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]
    save_photographs(folder, Photographs(tuple(views), UnitSphere(torch.tensor([3.0, 0, 0]).double(), 2.0), "ours"))


def test_a_folder_of_photographs_becomes_a_mesh_in_its_own_world(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_views(tmp_path / "views", ring(6, 40))
    monkeypatch.setattr(
        "distrace.cli.multiview.KNOWN_PLACE", replace(KNOWN_PLACE, rounds=2, coarse_rounds=1, iterations=1)
    )
    for name in ("SHOWN", "FRAMES"):
        monkeypatch.setattr(f"distrace.report.views_page.{name}", 2)
    out = tmp_path / "out"
    given = [str(model), str(tmp_path / "views"), "--out", str(out), "--fixed"]
    given += ["--starts", "1", "--rays", "500", "--resolution", "40", "--format", "glb", "ply"]
    monkeypatch.setattr("sys.argv", ["distrace", "multiview", *given])
    main()
    wanted = {"mesh.ply", "mesh.glb", "code.npy", "report.html", "forming.gif", "transforms.json", "result.json"}
    wanted.add("images")
    assert {path.name for path in out.iterdir()} == wanted
    result = json.loads((out / "result.json").read_text())
    assert result["unit_sphere"] == {"centre": [3.0, 0.0, 0.0], "radius": 2.0}
    assert np.allclose(result["T_unit_object"], np.eye(4))
    assert np.load(out / "code.npy").shape == (4,)
    taken = json.loads((tmp_path / "views" / "views.json").read_text())["views"]
    for frame, view in zip(json.loads((out / "transforms.json").read_text())["frames"], taken, strict=True):
        assert (out / frame["file_path"]).read_bytes() == (tmp_path / "views" / view["image"]).read_bytes()
        assert np.array_equal(frame["transform_matrix"], np.array(view["T_world_camera"]) @ np.diag([1, -1, -1, 1]))
    for name in ("mesh.ply", "mesh.glb"):
        mesh = trimesh.load(out / name, force="mesh")
        assert mesh.centroid == pytest.approx([3.0, 0, 0], abs=0.8)
        assert 1.0 < mesh.extents.max() < 4.0
    assert len(load_photographs(out).views) == 6, "`reconstruct` can read the folder"


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
