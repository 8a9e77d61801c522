"""The sparse-depth experiment on a box and an untrained decoder: its trials, what they see, and their tables."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh
from pretended import DEVICE, pretended

from distrace.checkpoints.model import Model, save_model
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.fitting.fit_code import CodeFitConfig
from distrace.mesh import MeshConfig, extract_mesh
from distrace.metrics import chamfer
from distrace.rays import meet_sphere
from experiments.tables import focal as focal_test
from experiments.tables import sparse_depth
from experiments.tables.depth_tables import AXES, depth_page, ratios, rows_of, wide
from experiments.tables.focal import renderings_of
from experiments.tables.sparse_depth import (
    AZIMUTHS_ELEVATIONS,
    CONDITIONS,
    DENSITIES,
    RATIOS,
    Done,
    Trial,
    all_trials,
    camera_of,
    done,
    held_out,
    observed,
    true_solid,
)
from experiments.tables.trials import Place

METHODS = ("deepsdf", "ours", "ours+mask")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """Two boxes, one of them held out, and a small decoder that knows neither."""
    folder = tmp_path_factory.mktemp("sparse")
    (folder / "meshes").mkdir()
    trimesh.creation.box((1.0, 0.6, 0.8)).export(folder / "meshes" / "box.ply")
    rows = [
        "name,split,design,turn,path,creator,licence",
        "a,train,a,0,box.ply,me,CC0-1.0",
        "b,test,b,0,box.ply,me,CC0-1.0",
    ]
    (folder / "boxes.csv").write_text("\n".join(rows) + "\n")
    torch.manual_seed(0)
    decoder = Decoder(NetworkSpecs(dims=(32,) * 3, code_length=4, latent_in=(), norm_layers=()))
    with torch.no_grad():
        for layer in range(3):  # about the distance to a ball (Atzmon and Lipman, SAL, CVPR 2020)
            getattr(decoder, f"lin{layer}").weight.normal_(0, (2 / 32) ** 0.5)
            getattr(decoder, f"lin{layer}").bias.zero_()
        decoder.lin0.weight[:, :4] *= 0.3  # pyright: ignore
        decoder.lin3.weight.normal_((math.pi / 32) ** 0.5, 1e-4)  # pyright: ignore
        decoder.lin3.bias.fill_(-0.6)  # pyright: ignore
    save_model(folder / "model", Model("boxes", decoder, 0.5 * torch.randn(6, 4), tuple("abcdef")), torch.float32)
    category = str(folder / "boxes.csv")
    return Place(folder, folder / "out", ((category, str(folder / "model")),), resolution=32)


def trial(place: Place, **known: object) -> Trial:
    return replace(Trial(place.models[0][0], "b", 0, "ours+mask"), **known)  # pyright: ignore


def test_every_cell_has_every_held_out_shape_from_every_view() -> None:
    trials = all_trials(("sofas", "planes"), METHODS, CONDITIONS["sparse-depth"](), shapes=None, views=4)
    shapes = len(held_out("sofas")) + len(held_out("planes"))
    assert len(trials) == len(set(trials)) == shapes * 4 * len(METHODS) * len(DENSITIES)
    assert len({each.file for each in trials}) == len(trials)
    assert {each.view for each in trials[: len(trials) // 4]} == {0}
    assert [shape.name for shape in held_out("planes", 3)] == [held_out("planes")[k].name for k in (0, 7, 14)]


@pytest.mark.parametrize("view", range(len(AZIMUTHS_ELEVATIONS)))
def test_at_every_focal_length_the_sphere_fills_as_much_of_the_image(view: int) -> None:
    shares = [meet_sphere(camera_of(view, ratio).rays()).meets.float().mean().item() for ratio in RATIOS]
    assert max(shares) - min(shares) < 0.002
    lengths = [float(camera_of(view, ratio).intrinsics[0, 0]) for ratio in (0.5, 2.0)]
    assert lengths[1] == pytest.approx(4 * lengths[0])


def test_a_density_says_how_many_depths_are_left(place: Place) -> None:
    counts = {density: int(observed(trial(place, density=density), place.meshes).seen.sum()) for density in DENSITIES}
    assert counts["100"] == 100
    assert counts["20"] == 20
    assert counts["10%"] == pytest.approx(counts["dense"] / 10, abs=1)
    view = observed(trial(place, density="20"), place.meshes)
    assert view.mask is not None
    assert view.mask.sum() == counts["dense"]


@pytest.mark.slow
def test_a_trial_is_kept_until_the_model_changes(place: Place) -> None:
    wanted = trial(place, density="20")
    first = done(place, wanted)
    path = place.out / "trials" / wanted.file
    kept = path.read_text()
    assert done(place, wanted) == first
    assert path.read_text() == kept
    path.write_text(json.dumps(json.loads(kept) | {"made_by": "another model", "seconds": -1.0}))
    again = done(place, wanted)
    assert again.seconds > 0
    assert again.chamfer == pytest.approx(first.chamfer, rel=1e-6)


@pytest.mark.slow
def test_shapes_are_completed_and_looked_at_on_the_device(
    place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = CodeFitConfig(iterations=4, starts=1)
    monkeypatch.setattr(focal_test, "RATIOS", (1.0,))
    monkeypatch.setattr(sparse_depth, "CodeFitConfig", lambda: short)
    wanted, here = trial(place, density="20"), replace(place, out=tmp_path / "here")
    there = replace(here, out=tmp_path / "there", device=DEVICE)
    with pretended(monkeypatch):
        assert done(there, wanted).chamfer == pytest.approx(done(here, wanted).chamfer, rel=0.05)
        overlaps = [[rendering.iou for rendering in renderings_of(where, wanted)] for where in (there, here)]
    assert overlaps[0] == pytest.approx(overlaps[1], abs=0.03)


@pytest.mark.parametrize("method", ["deepsdf", "ours", "points", "points+normals"])
def test_every_method_brings_a_ball_nearer_to_the_box(place: Place, method: str) -> None:
    result = done(place, trial(place, method=method, density="100"))
    model = place.model_of(result.trial.category)
    start = extract_mesh(model.field(torch.zeros(4)), MeshConfig(place.resolution))
    truth = true_solid(place.meshes, result.trial.category, "b").surface
    assert 0 < result.chamfer < chamfer(start, truth).sum
    assert len(result.code) == 4


def test_another_method_is_named(place: Place) -> None:
    with pytest.raises(ValueError, match=r"no method 'magic'; give some of deepsdf, ours, ours\+mask"):
        done(place, trial(place, method="magic"))


def test_a_resolution_that_no_mesh_has_is_refused_before_the_fit(place: Place) -> None:
    with pytest.raises(ValueError, match="resolution"):
        done(replace(place, resolution=1), trial(place, method="magic"))


def made(method: str, density: str, chamfer: float, shape: str = "b") -> Done:
    return Done(Trial("sofas", shape, 0, method, density), chamfer / 4, 3 * chamfer / 4, 1.0, 10, [0.0])


def test_rows_are_medians_and_ratios_are_averaged_over_columns() -> None:
    results = [
        made("deepsdf", density, value, shape) for density in ("dense", "20") for shape, value in zip("abc", (2, 4, 9))
    ]
    results += [made("ours", "dense", 2.0), made("ours", "20", 3.0)]
    rows = rows_of(results, "density")
    assert [(row["method"], row["density"], row["chamfer_median"], row["n"]) for row in rows] == [
        ("deepsdf", "dense", 4.0, 3),
        ("deepsdf", "20", 4.0, 3),
        ("ours", "dense", 2.0, 1),
        ("ours", "20", 3.0, 1),
    ]
    assert ratios(rows, "density") == {"sofas": {"ours": pytest.approx(0.625)}}
    header, cells = wide(rows, "density")
    assert header == ["class", "method", "dense", "20"]
    assert cells == [["sofas", "deepsdf", "4.00", "4.00"], ["sofas", "ours", "2.00", "3.00"]]


def test_the_page_shows_table_pictures_and_apart_from_them_the_published_one(place: Place) -> None:
    results = [done(place, trial(place, method=method, density="100")) for method in ("points", "ours+mask")]
    text = depth_page("sparse-depth", results, place)
    assert text.count("<img") == 1
    assert "not comparable" in text
    assert "b, " in text
    assert "averaged over columns" not in text, "without DeepSDF there is nothing to average"
    assert AXES["noise"] == "noise"
