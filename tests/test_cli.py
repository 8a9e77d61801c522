"""The command line: the files and keys that other people's scripts rely on, and one line for whatever goes wrong."""

import json
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from test_train import RADII, of_sphere, save_two_spheres

import distrace.cli
import distrace.cli.train_samples
import distrace.movie
from distrace.camera import Camera
from distrace.checkpoints.model import load_model, save_experiment
from distrace.cli import COMMANDS, parsed, show
from distrace.cli.console import Run, console, progress
from distrace.cli.scan_completion import ScanTask, complete_scan
from distrace.data.observation import View, load_view, read_view, save_view
from distrace.data.samples import write_samples
from distrace.fitting.judge import Verdict
from distrace.pose import turned_object, zoomed
from distrace.rays import meet_sphere
from distrace.render import Buffers, render

COMMON = {"seconds", "device", "version"}
Command = Callable[..., None]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_two_spheres(tmp_path_factory.mktemp("models") / "spheres")


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages with few, small pictures, and distances from few points: most of a completion's time."""
    monkeypatch.setattr("distrace.metrics.POINTS", 3000)
    monkeypatch.setattr("distrace.cli.completion.CLOUD_SIZE", 32)
    monkeypatch.setattr("distrace.cli.completion.OTHERS_SIDE", 24)
    monkeypatch.setattr("distrace.cli.scan_completion.SIDE", 32)
    monkeypatch.setattr("distrace.cli.scan_completion.VIEWS", {"front": (0, 15)})


@pytest.fixture(scope="module")
def observation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sphere of radius 0.6, in closed form."""
    camera = Camera.orbit(30, 20, 2.5, height=32, width=32, focal_px=32.0)
    bounds = meet_sphere(camera.rays(), 0.6)
    path = tmp_path_factory.mktemp("observations") / "view.npz"
    save_view(path, View(camera, camera.depth(bounds.near), bounds.meets))
    return path


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Iterator[Command]:
    """The command line, in this process; whatever it sets for the process is set back."""

    def command(*arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", ["distrace", *map(str, arguments)])
        distrace.cli.main()

    yield command
    torch.set_flush_denormal(False)


def result(out: Path, *keys: str) -> dict:
    """`result.json`, after a look at its keys."""
    content = json.loads((out / "result.json").read_text())
    assert set(keys) | COMMON <= set(content)
    assert content["seconds"] > 0
    return content


COMPLETED = {
    "result.json",
    "scan.npz",
    "mesh.ply",
    "mesh.glb",
    "placement.json",
    "code.npy",
    "report.html",
    "shaded.png",
}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


VIEW = ("--distance", "2.5", "--focal-mm", "32", "--size", "32")


def test_render_writes_arrays_and_pictures(model: Path, run: Command, tmp_path: Path) -> None:
    run("render", model, "--code", 1, "--out", tmp_path, *VIEW)
    pictures = {"depth.png", "normal.png", "mask.png", "shaded.png"}
    assert names(tmp_path) == {"result.json", "buffers.npz", "view.npz", *pictures}
    observed = load_view(tmp_path / "view.npz")
    with np.load(tmp_path / "buffers.npz") as archive:
        arrays = {name: archive[name] for name in archive.files}
    assert set(arrays) == {"depth", "distance", "normal", "mask", "evaluations", "outcome"}
    assert all(array.shape[:2] == (32, 32) for array in arrays.values())
    assert all(Image.open(tmp_path / name).size == (32, 32) for name in pictures)
    camera = Camera.orbit(30, 20, 2.5, focal_mm=32, sensor_mm=32, height=32, width=32)
    torch.testing.assert_close(observed.camera.T_world_camera, camera.T_world_camera)
    assert (observed.depth.numpy() == arrays["depth"]).all()
    closed_form = camera.depth(meet_sphere(camera.rays(), RADII[1]).near).numpy()
    both = arrays["mask"] & np.isfinite(closed_form)
    assert both.sum() > 0.8 * np.isfinite(closed_form).sum()
    assert np.median(np.abs(arrays["depth"][both] - closed_form[both])) < 0.03
    facts = result(tmp_path, "evaluations", "setup_evaluations", "gradient_evaluations", "clearance_evaluations")
    assert facts["evaluations"] == arrays["evaluations"].sum() + facts["setup_evaluations"]
    assert facts["setup_evaluations"] > 0
    assert facts["clearance_evaluations"] == 0
    assert facts["gradient_evaluations"] == facts["outcomes"]["hit"] == arrays["mask"].sum()


def test_samples_background_and_light_change_pictures_and_no_arrays(model: Path, run: Command, tmp_path: Path) -> None:
    run("render", model, "--out", tmp_path / "plain", *VIEW)
    look = ("--samples", 3, "--background", "transparent", "--light=-60,10")
    run("render", model, "--out", tmp_path / "fine", *look, *VIEW)
    plain, fine = (
        {name: np.asarray(Image.open(tmp_path / kind / f"{name}.png")) for name in ("shaded", "mask", "normal")}
        for kind in ("plain", "fine")
    )
    assert fine["shaded"].shape == (32, 32, 4)
    assert (plain["normal"] == fine["normal"]).all()
    assert len(np.unique(plain["mask"])) < len(np.unique(fine["mask"]))
    left, right = fine["shaded"][16, 10, :3].sum(), fine["shaded"][16, 22, :3].sum()
    assert left > right + 100
    with np.load(tmp_path / "plain" / "buffers.npz") as one, np.load(tmp_path / "fine" / "buffers.npz") as other:
        assert all((one[name] == other[name]).all() for name in one.files)
    assert result(tmp_path / "fine")["sample_evaluations"] > result(tmp_path / "fine")["evaluations"]
    run("render", model, "--out", tmp_path / "blue", "--background", "0,0,255", *VIEW)
    assert np.asarray(Image.open(tmp_path / "blue" / "shaded.png"))[0, 0].tolist() == [0, 0, 255]


def test_render_counts_what_the_clearance_costs(model: Path, run: Command, tmp_path: Path) -> None:
    run("render", model, "--clearance", "--strategy", "parallel", "--out", tmp_path, *VIEW)
    with np.load(tmp_path / "buffers.npz") as archive:
        clearance, mask = archive["clearance"], archive["mask"]
    assert np.mean(clearance[~mask] > 0) > 0.99, "a learnt field is no exact distance: a march may just miss"
    assert np.abs(clearance[mask]).max() < 1e-3
    facts = result(tmp_path)
    assert facts["clearance_evaluations"] > 0
    assert facts["setup_evaluations"] == 0
    assert facts["strategy"] == "parallel"


@pytest.mark.parametrize(("strategy", "size"), [("fast", 33), ("dynamic", 16)])
def test_render_in_an_orbit_also_writes_movies(
    strategy: str, size: int, model: Path, run: Command, tmp_path: Path
) -> None:
    view = ("--code", 1, "--distance", 2.5, "--focal-mm", 32, "--size", size, "--strategy", strategy)
    run("render", model, *view, "--out", tmp_path / "still")
    run("render", model, *view, "--orbit", 3, "--out", tmp_path / "turn")
    still, turn = tmp_path / "still", tmp_path / "turn"
    assert names(turn) == names(still) | {"turntable.mp4", "turntable.gif"}
    for name in names(still) - {"result.json"}:
        assert (turn / name).read_bytes() == (still / name).read_bytes(), "the first view is the one without a turn"
    with av.open(str(turn / "turntable.mp4")) as movie:
        frames = [frame.to_ndarray(format="rgb24") for frame in movie.decode(video=0)]
    assert [frame.shape for frame in frames] == 3 * [(size + size % 2, size + size % 2, 3)]
    first = np.asarray(Image.open(turn / "shaded.png")).astype(int)
    assert np.abs(frames[0][:size, :size] - first).mean() < 5
    assert Image.open(turn / "turntable.gif").n_frames == 3


def test_an_orbit_counts_all_its_frames_and_reuses_what_the_first_has_learnt(
    model: Path, run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("render", model, "--orbit", 3, "--clearance", "--out", tmp_path / "turn", *VIEW)
    facts = result(tmp_path / "turn", "frames", "evaluations_per_visible_pixel")
    assert facts["frames"] == 3
    singly, placed = [], show.Render.camera
    for k in range(3):  # as the orbit turns them: an azimuth of as much is off by rounding
        monkeypatch.setattr(show.Render, "camera", lambda view, turn=120 * k: placed(view).turned(turn))
        singly.append(still_facts(model, run, tmp_path / str(k)))
    first, *others = singly
    assert facts["setup_evaluations"] == first["setup_evaluations"] > 0, "the lattice is built once"
    assert facts["evaluations"] == first["evaluations"] + sum(
        other["evaluations"] - other["setup_evaluations"] for other in others
    )
    assert facts["gradient_evaluations"] == sum(still["gradient_evaluations"] for still in singly)
    assert facts["clearance_evaluations"] == first["clearance_evaluations"] > 0, "the first view's alone"
    hits = [still["outcomes"]["hit"] for still in singly]
    per_pixel = facts["evaluations_per_visible_pixel"]
    assert facts["evaluations"] == pytest.approx(np.dot(per_pixel, hits))
    assert per_pixel[0] == pytest.approx(first["evaluations"] / hits[0])
    assert "frames" not in first
    assert "evaluations_per_visible_pixel" not in first


def still_facts(model: Path, run: Command, out: Path) -> dict:
    run("render", model, "--clearance", "--out", out, *VIEW)
    return result(out)


def test_an_orbit_that_sees_nothing_is_a_white_movie(model: Path, run: Command, tmp_path: Path) -> None:
    run("render", model, "--orbit", 2, "--distance", 9000, "--focal-mm", 1, "--size", 16, "--out", tmp_path)
    facts = result(tmp_path)
    assert facts["outcomes"]["hit"] == 0
    assert facts["evaluations_per_visible_pixel"] == [None, None]
    assert (np.asarray(Image.open(tmp_path / "turntable.gif").convert("RGB")) == 255).all()


def test_ctrl_c_in_an_orbit_leaves_the_first_view_and_no_half_movie(
    model: Path, run: Command, capsys: pytest.CaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered = []

    def interrupted(*arguments: object, **options: object) -> Buffers:
        if rendered:
            raise KeyboardInterrupt
        rendered.append(render(*arguments, **options))
        return rendered[0]

    monkeypatch.setattr(distrace.movie, "render", interrupted)
    said = one_line(run, capsys, ("render", model, "--orbit", 3, "--out", tmp_path, *VIEW), status=130)
    assert "interrupted" in said
    assert names(tmp_path) == {"buffers.npz", "view.npz", "depth.png", "normal.png", "mask.png", "shaded.png"}


def test_shapes_lists_numbers_and_names(
    model: Path, run: Command, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    run("shapes", model, "--out", tmp_path)
    assert names(tmp_path) == {"result.json"}
    shapes = load_model(model).shapes
    assert result(tmp_path, "shapes")["shapes"] == list(shapes)
    said = capsys.readouterr().out
    assert all(f"{number} {name}" in said for number, name in enumerate(shapes))
    assert "2 shapes are listed\n" in said


@pytest.mark.parametrize(
    ("options", "listed"),
    [
        ((), ["couch", "stool"]),
        (("--all",), ["couch", "couch~mirrored", "stool", "sofas~1", "sofas~2", "sofas~3"]),
        (("--name", "Couch"), ["couch"]),
        (("--name", "couch", "--all"), ["couch", "couch~mirrored"]),
    ],
)
def test_shapes_lists_meshes_and_with_all_their_variants(
    options: tuple[str, ...],
    listed: list[str],
    run: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = ("couch", "couch~mirrored", "stool", "sofas~1", "sofas~2", "sofas~3")
    of_names = SimpleNamespace(shapes=names)
    monkeypatch.setattr("distrace.cli.shapes.opened_for", lambda run, name: of_names)
    run("shapes", "sofas", *options, "--out", tmp_path)
    said = capsys.readouterr().out.splitlines()
    assert [line.split() for line in said[: len(listed)]] == [[str(names.index(name)), name] for name in listed]
    rest = " ".join(" ".join(said[len(listed) :]).split())
    assert rest.startswith(f"{len(listed)} shapes are listed; the model has 2 of meshes, 1 variants")
    assert "3 procedural ones" in rest


def test_render_warns_of_a_camera_in_the_solid(
    model: Path, run: Command, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    run("render", model, "--code", 1, "--distance", 0.3, "--size", 16, "--out", tmp_path)
    assert "warning: 256 of 256 rays start inside the solid: is the camera in it" in capsys.readouterr().err


@pytest.mark.parametrize(("given", "columns"), [("1", 1), ("all", 2), ("9", 2)])
def test_shapes_draws_the_first_shapes_in_one_sheet(
    given: str, columns: int, model: Path, run: Command, tmp_path: Path
) -> None:
    run("shapes", model, "--thumbnails", given, "--out", tmp_path)
    sheet = np.asarray(Image.open(tmp_path / "shapes.png"))
    assert sheet.shape == (96 + 30, columns * (96 + 8) - 8, 3)
    for left in range(0, sheet.shape[1], 104):
        assert (sheet[:96, left : left + 96] < 200).any(), "a shape"
        assert (sheet[96:, left : left + 96] < 120).any(), "its name"
    facts = result(tmp_path, "shapes", "evaluations")
    assert facts["thumbnails"] == columns
    assert facts["evaluations"] > 1000


def test_mesh_writes_a_mesh(model: Path, run: Command, tmp_path: Path) -> None:
    for code, radius in enumerate(RADII):
        out = tmp_path / str(code)
        run("mesh", model, "--code", code, "--resolution", 16, "--out", out)
        assert names(out) == {"result.json", "mesh.ply"}
        mesh = trimesh.load(out / "mesh.ply", process=False)
        assert np.linalg.norm(mesh.vertices, axis=1).mean() == pytest.approx(radius, abs=0.04)
        facts = result(out, "evaluations", "setup_evaluations")
        assert facts["faces"] == len(mesh.faces)
        assert facts["evaluations"] > 1000


def test_mesh_writes_each_format_that_was_given_and_no_other(model: Path, run: Command, tmp_path: Path) -> None:
    run("mesh", model, "--resolution", 16, "--format", "glb", "obj", "--out", tmp_path)
    assert names(tmp_path) == {"result.json", "mesh.glb", "mesh.obj"}
    faces = result(tmp_path)["faces"]
    for name in ("mesh.glb", "mesh.obj"):
        mesh = trimesh.load(tmp_path / name, process=False, force="mesh")
        assert len(mesh.faces) == faces
        assert np.linalg.norm(mesh.vertices, axis=1).mean() == pytest.approx(RADII[0], abs=0.04)


def test_complete_writes_a_mesh_a_code_and_a_page(model: Path, observation: Path, run: Command, tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=3, radius=0.6).export(tmp_path / "true.ply")
    options = ("--points", 50, "--solver", "adam", "--iterations", 15, "--starts", 1, "--resolution", 16)
    run("complete", model, observation, "--reference", tmp_path / "true.ply", *options, "--out", tmp_path / "out")
    out = tmp_path / "out"
    assert names(out) == COMPLETED
    facts = result(out, "evaluations", "setup_evaluations", "loss", "chamfer_to", "chamfer_from", "chamfer")
    assert facts["evaluations"] > 1000
    assert facts["chamfer"] == pytest.approx(facts["chamfer_to"] + facts["chamfer_from"])
    assert facts["chamfer"] < 5, "the mean shape is off by 0.075: 2 × 5.6"
    code = np.load(out / "code.npy")
    assert code.shape == (4,)
    fitted = load_model(model).field(torch.from_numpy(code))
    mesh = trimesh.load(out / "mesh.ply", process=False)
    assert fitted(torch.tensor(mesh.vertices).float()).abs().max() < 0.03, "the mesh is the code's"
    assert "<html" in (out / "report.html").read_text(encoding="utf-8")[:500]


def test_complete_finds_where_the_shape_is(model: Path, run: Command, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.2)
    ball.apply_translation((5.0, -3.0, 9.0))
    ball.export(tmp_path / "true.ply")
    ball.update_faces(ball.triangles_center[:, 2] > 8.5)
    ball.remove_unreferenced_vertices()
    ball.export(tmp_path / "part.ply")
    options = ("--reference", tmp_path / "true.ply", "--resolution", 24, "--up", "z", "--strict", "--format", "obj")
    run("complete", model, tmp_path / "part.ply", *options, "--out", tmp_path / "out")
    out = tmp_path / "out"
    assert names(out) == COMPLETED | {"mesh.obj"}
    facts = result(
        out, "evaluations", "verdict", "explained", "free_space_violated", "disagreement", "reason", "chamfer"
    )
    assert facts["verdict"] == "trusted"
    matrix = np.array(json.loads((out / "placement.json").read_text())["T_input_object"])
    assert np.abs(matrix[:3, 3] - (5.0, -3.0, 9.0)).max() < 0.15
    for name in ("mesh.ply", "mesh.glb", "mesh.obj"):
        vertices = trimesh.load(out / name, process=False, force="mesh").vertices
        assert np.linalg.norm(vertices - (5.0, -3.0, 9.0), axis=1).mean() == pytest.approx(1.2, abs=0.06)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert 'class="banner trusted"' in page


def test_a_completion_that_fails_says_so_and_strict_tells_the_shell(
    model: Path, run: Command, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    trimesh.PointCloud(np.random.default_rng(0).uniform(0, 30, (1000, 3))).export(tmp_path / "fog.ply")
    verdicts: list[Verdict] = []

    def completed_once(run: Run, task: ScanTask) -> Verdict:
        if not verdicts:
            verdicts.append(complete_scan(run, task))
        return verdicts[0]

    monkeypatch.setattr("distrace.cli.complete.complete_scan", completed_once)
    options = ("--resolution", 16, "--out", tmp_path / "out")
    run("complete", model, tmp_path / "fog.ply", *options)
    assert result(tmp_path / "out", "verdict")["verdict"] == "failed"
    assert "failed: " in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        run("complete", model, tmp_path / "fog.ply", "--strict", *options)
    assert stopped.value.code == 3


def test_complete_takes_points_and_says_what_else_would_fit(model: Path, run: Command, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    ball.update_faces(ball.triangles_center[:, 2] > 0)
    ball.remove_unreferenced_vertices()
    ball.export(tmp_path / "half.ply")
    options = ("--frame", "canonical", "--plausible", 2, "--resolution", 16)
    run("complete", model, tmp_path / "half.ply", *options, "--out", tmp_path / "out")
    out = tmp_path / "out"
    others = {"plausible-1.ply", "plausible-2.ply"}
    assert names(out) == COMPLETED | others
    mesh = trimesh.load(out / "mesh.ply", process=False)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.6).mean() < 0.05
    spread = mesh.metadata["_ply_raw"]["vertex"]["data"]["spread"]
    assert spread.shape == (len(mesh.vertices),)
    assert (spread >= 0).all()
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "A shape completed from points" in page
    assert "Other shapes that fit" in page


@pytest.mark.slow
def test_train_samples_a_folder_of_meshes_first(run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine").mkdir()
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "mine" / "box.ply")
    monkeypatch.setattr(distrace.cli.train_samples, "MESH_SAMPLES", 2000)
    monkeypatch.setattr(distrace.cli.train_samples.os, "cpu_count", lambda: 1)
    size = ("--layers", 2, "--width", 16, "--code-length", 4)
    run("train", tmp_path / "mine", "--steps", 3, *size, "--out", tmp_path / "model")
    assert load_model(tmp_path / "model").shapes == ("box", "box~warped1", "box~warped2")
    run("train", tmp_path / "mine", "--steps", 5, "--out", tmp_path / "model")
    assert result(tmp_path / "model")["steps"] == 5, "a longer run goes on from where the shorter one ended"


def test_complete_in_a_few_iterations_still_ends_with_a_code(
    model: Path, observation: Path, run: Command, tmp_path: Path
) -> None:
    run("complete", model, observation, "--iterations", 2, "--resolution", 8, "--out", tmp_path)
    assert np.isfinite(np.load(tmp_path / "code.npy")).all()
    assert "chamfer" not in result(tmp_path), "nothing was given to measure against"


def test_complete_by_levenberg_marquardt(model: Path, observation: Path, run: Command, tmp_path: Path) -> None:
    run("complete", model, observation, "--starts", 2, "--resolution", 16, "--out", tmp_path)
    fitted = load_model(model).field(torch.from_numpy(np.load(tmp_path / "code.npy")))
    surface = 0.6 * torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    assert fitted(surface).abs().mean() < 0.03
    result(tmp_path, "evaluations", "loss", "verdict")
    assert "start 2" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_pose_finds_how_far_away_a_sphere_is(model: Path, observation: Path, run: Command, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run("pose", model, observation, "--code", 1, "--azimuth", 80, "--distance", 3.2, "--starts", 2, "--out", out)
    assert names(out) == {"result.json", "posed.npz", "code.npy", "filmstrip.png"}
    found = result(out, "T_world_camera", "intrinsics", "share_of_rays_off", "iterations", "evaluations")
    assert np.linalg.norm(np.array(found["T_world_camera"])[:3, 3]) == pytest.approx(2.5, abs=0.1)
    assert load_view(out / "posed.npz").camera.T_world_camera.tolist() == found["T_world_camera"]
    assert found["percent_from_observation"] < 5
    assert Image.open(out / "filmstrip.png").width > 100


def test_pose_warns_of_a_camera_that_disagrees(model: Path, observation: Path, run: Command, tmp_path: Path) -> None:
    for code, doubtful in ((1, False), (0, True)):  # the observation's sphere, and a smaller one
        words = ("--code", code, "--starts", 1, "--out", tmp_path / str(code))
        run("pose", model, observation, *words)
        warnings = result(tmp_path / str(code))["warnings"]
        assert any("camera is doubtful" in warning for warning in warnings) == doubtful


def test_pose_finds_the_focal_length_and_starts_where_it_is_told(
    model: Path, observation: Path, run: Command, tmp_path: Path
) -> None:
    view = read_view(observation)
    start = zoomed(turned_object(view.camera, torch.tensor([0.0, 0.09, 0.0]), torch.zeros(3)), torch.tensor(1.1).log())
    save_view(tmp_path / "off.npz", replace(view, camera=start))
    words = ("--code", 1, "--starts", 1, "--ignore", "normal", "--out")
    run("pose", model, tmp_path / "off.npz", "--focal", *words, tmp_path / "found")
    assert result(tmp_path / "found")["intrinsics"][0][0] == pytest.approx(32, rel=0.05)
    run("pose", model, tmp_path / "off.npz", *words, tmp_path / "kept")
    assert result(tmp_path / "kept")["intrinsics"][0][0] == pytest.approx(35.2, abs=1e-3)


def test_mesh_says_what_is_doubtful_of_a_field(
    model: Path, run: Command, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    run("mesh", model, "--resolution", 16, "--out", tmp_path)
    assert result(tmp_path)["warnings"] == []
    assert capsys.readouterr().err == ""
    known = load_model(model)
    last = getattr(known.decoder, f"lin{known.decoder.depth - 1}")
    torch.nn.init.constant_(last.bias, -last.bias.item())
    last.weight = torch.nn.Parameter(-last.weight.detach())
    save_experiment(tmp_path / "inverted", known.decoder, known.codes, known.shapes)
    run("mesh", tmp_path / "inverted", "--resolution", 16, "--out", tmp_path)
    (sentence,) = result(tmp_path)["warnings"]
    assert "is its sign inverted?" in sentence
    assert capsys.readouterr().err == f"distrace: warning: {sentence}\n"


def test_bench_writes_a_table(model: Path, run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("distrace.benchmarks.ablation.NAIVE_RAYS", 10)
    run("bench", "trace", model, "--code", 1, "--size", 16, "--repeats", 1, "--out", tmp_path)
    assert names(tmp_path) == {"result.json", "evaluations.png"}
    facts = result(tmp_path, "rows", "command", "machine", "evaluations")
    assert facts["command"].startswith("distrace bench trace")
    columns = {"model", "strategy", "queries", "setup_queries", "seconds", "hits", "iou", "outliers"}
    columns |= {"depth_mean", "depth_p99", "depth_max"}
    assert all(columns <= set(row) for row in facts["rows"])
    assert {"parallel", "dynamic", "aggressive", "coarse_to_fine"} <= {row["strategy"] for row in facts["rows"]}
    assert facts["evaluations"] == sum(row["queries"] for row in facts["rows"])


def test_bench_views_writes_rows_a_summary_and_the_worst_views(model: Path, run: Command, tmp_path: Path) -> None:
    views = ("--sizes", 16, 24, "--seed", 5)
    run("bench", "views", model, "--views", 3, *views, "--out", tmp_path / "first")
    assert names(tmp_path / "first") == {"result.json", "worst.png"}
    facts = result(tmp_path / "first", "rows", "summary", "command", "machine", "evaluations", "setup_evaluations")
    columns = {"model", "code", "camera", "pixels", "missed", "added", "iou", "largest_loss", "off", "evaluations"}
    assert all(columns | {"per_pixel", "exhausted", "seconds", "fails"} <= set(row) for row in facts["rows"])
    camera = {"azimuth", "elevation", "distance", "focal_mm", "target", "size"}
    assert all(set(row["camera"]) == camera and 16 <= row["camera"]["size"] <= 24 for row in facts["rows"])
    assert set(facts["rows"][2]["code"]) == {"first", "second", "share"}
    assert facts["evaluations"] == sum(row["evaluations"] for row in facts["rows"])
    assert [line["model"] for line in facts["summary"]] == [model.name]
    run("bench", "views", model, "--views", 1, *views, "--strategy", "dynamic", "--out", tmp_path / "second")
    (again,) = result(tmp_path / "second", "rows")["rows"]
    assert again["strategy"] == "dynamic"
    for key in ("code", "camera", "pixels"):
        assert again[key] == facts["rows"][0][key], key


def test_without_a_command_or_with_help_it_says_what_there_is(run: Command, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stopped:
        run("--help")
    assert stopped.value.code == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("demo", "render", "mesh", "complete", "train", "bench"))


def one_line(
    run: Command, capsys: pytest.CaptureFixture, arguments: tuple, status: int = 2, program: str = "distrace"
) -> str:
    """Runs what is to fail; its line on stderr."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        run(*arguments)
    said = capsys.readouterr().err
    assert stopped.value.code == status
    assert "Traceback" not in said
    assert said.count("\n") == 1, said
    assert said.startswith(f"{program}: ")
    assert len(said) > 20
    assert "---- " not in said
    return said


@pytest.fixture
def place(tmp_path: Path, model: Path, observation: Path) -> dict[str, str]:
    """What the arguments below name in braces."""
    (tmp_path / "text").write_text("no observation, no mesh, no split\n")
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "nothing").mkdir()
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "specs.json").write_text("{")
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "chair.obj").write_text("no mesh\n")
    (tmp_path / "samples").mkdir()
    (tmp_path / "samples" / "chair.npz").write_text("no samples\n")
    (tmp_path / "stopped").mkdir()
    (tmp_path / "stopped" / "checkpoint.pt").write_text("no checkpoint\n")
    write_samples(tmp_path / "good" / "chair.npz", of_sphere(0.5).astype(np.float32))
    nowhere = np.array([[0.0, 0, 0], [1, 0, 0], [np.nan, 0, 0]])
    for name, points in (("nan", nowhere), ("flat", np.nan_to_num(nowhere))):
        trimesh.Trimesh(points, [[0, 1, 2]], process=False).export(tmp_path / f"{name}.ply")
    np.save(tmp_path / "nan.npy", np.full(4, np.nan, dtype=np.float32))
    save_view(tmp_path / "silhouette.npz", load_view(observation).without("depth"))
    save_view(tmp_path / "empty.npz", nothing_seen())
    view = {"view": str(observation), **{name: str(tmp_path / f"{name}.npz") for name in ("silhouette", "empty")}}
    out = str(tmp_path / "out")
    return {"tmp": str(tmp_path), "model": str(model), "out": out, **view}


def nothing_seen() -> View:
    """The view that `render` writes where no ray hits."""
    camera = Camera.orbit(0, 0, 4, height=8, width=8)
    return View(camera, torch.full((8, 8), torch.inf), torch.zeros(8, 8, dtype=torch.bool), torch.zeros(8, 8, 3))


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_what_each_option_defaults_to(name: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        parsed([name, "--help"])
    text = " ".join(re.sub(r"[\u2500-\u257f]", " ", capsys.readouterr().out).split())
    assert text.startswith(f"usage: distrace {name}")
    assert re.search(r"\(default:[ ,'\"]*\)", text) is None


BAD = [
    ("", "distrace: Expected one of {demo, render"),
    ("paint", "paint"),
    ("render", "MODEL"),
    ("render {tmp}/missing", "neither a folder nor a bundled model"),
    ("render {tmp}/text", "neither a folder nor a bundled model"),
    ("render {tmp}/nothing", "no specs.json"),
    ("render {tmp}/damaged", "not a DeepSDF specification"),
    ("render {model} --colour red", "--colour"),
    ("render {model} --size many", "'many'; expected --size INT pixels along each side (default: 512); see distrace"),
    ("render {model} --out {tmp}/text", "text is a file; give another to write to"),
    ("render {model} --out {tmp}/text/below", "text is a file; give another to write to"),
    ("render {model} --code 2", "code 2 was given; spheres has 2"),
    ("render {model} --code -1", "-1 is neither the number nor the name of a training shape"),
    ("render {model} --size -3", "-3 × -3"),
    ("render {model} --size 0", "0 × 0"),
    ("render {model} --size 4000000", "not enough memory for --size 4000000 --samples 1; use a smaller size"),
    ("render {model} --strategy dynamic --steps 0", "steps=0"),
    ("render {model} --steps 5", "fast counts none"),
    ("render {model} --samples 0", "--samples 0 was given; give a whole number from 1 to 16"),
    ("render {model} --background 1,2", "--background 1,2 was given; give white, transparent, or R,G,B"),
    ("render {model} --background 1,2,256", "--background 1,2,256 was given"),
    ("render {model} --background a,1,2,3", "--background a,1,2,3 was given"),
    ("render {model} --light 30", "--light 30 was given; give AZIMUTH,ELEVATION"),
    ("render {model} --light 30,inf", "--light 30,inf was given"),
    ("render {model} --orbit 4 --background transparent", "a movie needs a colour"),
    ("render {model} --orbit 1", "an orbit of 1 frames"),
    ("render {model} --orbit 0", "an orbit of 0 frames"),
    ("render {model} --orbit -3", "an orbit of -3 frames"),
    ("render {model} --orbit many", "--orbit"),
    ("render {model} --focal-mm 0", "focal length"),
    ("render {model} --sensor-mm -1", "focal length"),
    ("render {model} --azimuth nan", "nan"),
    ("render {model} --distance 0", "its own place"),
    ("render {model} --distance -3", "--distance -3.0 was given; it cannot be negative"),
    ("render {model} --strategy slow", "--strategy"),
    ("render {model} --colour a[/y]z", "a[/y]z"),
    ("render {tmp}/a[/y]z", "a[/y]z is neither a folder nor a bundled model"),
    ("pose {model} {view} --azimuth 0 --distance -3", "--distance -3.0 was given"),
    ("render {model} --device tpu", "--device tpu is no device"),
    ("render {model} --device mps", "--device mps is not supported"),
    ("mesh {model} --resolution 3", "resolution of 3"),
    ("shapes {model} --thumbnails -1", "--thumbnails -1 was given"),
    ("shapes {model} --thumbnails some", "--thumbnails"),
    ("shapes sofas --name nowhere", "--name nowhere was given, and no listed shape has it in its name"),
    ("shapes sofas --name warped1", "--all lists 16 variants and procedural shapes"),
    ("shapes {tmp}/nothing", "no specs.json"),
    ("mesh {model} --resolution 20", "resolution of 20"),
    ("mesh {model} --code 9", "code 9"),
    ("mesh {model} --format stl", "Invalid choice 'stl'"),
    ("mesh {model} --format", "--format was given without a format"),
    ("complete {model} {view} --format stl", "Invalid choice 'stl'"),
    ("bench trace {model} --size 0", "0 × 0"),
    ("bench everything {model}", "trace"),
    ("bench trace", "bench trace was given no model"),
    ("bench views {model} {tmp}/missing", "neither a folder nor a bundled model"),
    ("bench views {model} --views 0", "--views 0"),
    ("bench views {model} --sizes 64 32", "--sizes 64 32"),
    ("bench views {model} --strategy slow", "--strategy slow was given; choose one of parallel"),
    ("bench views {model} --seed -1", "--seed -1"),
    ("bench trace {tmp}/missing", "neither a folder nor a bundled model"),
    ("complete {model} {tmp}/missing.npz", "does not exist"),
    ("complete {model} {tmp}/text", "text is not an observation"),
    ("complete {model} {tmp}/missing.ply", "missing.ply does not exist"),
    ("complete {model} {view} --plausible -1", "--plausible -1"),
    ("complete {model} {tmp}/empty", "empty is not an observation"),
    ("complete {model} {view} --points 0", "--points 0"),
    ("complete {model} {view} --iterations 0", "0 iterations"),
    ("complete {model} {view} --starts 0", "0 starts"),
    ("complete {model} {view} --reference {tmp}/text", "no mesh and no cloud"),
    ("complete {model} {view} --reference {tmp}/missing.ply", "does not exist"),
    ("complete {model} {view} --ignore depth", "distrace: Invalid choice 'depth' for argument '--ignore'"),
    ("complete {model} {view} --frame world", "Expected one of ("),
    ("complete {model} {view} --box 1 2 3", "Error parsing --box: another value was given; expected --box LEFT TOP"),
    ("complete {model} {view} --poses {tmp}/text", "--poses was given, which --frame canonical does not use"),
    ("complete {model} {tmp}/a.png {tmp}/b.png --intrinsics 9,9,4,4", "2 depth images were given without --poses"),
    ("complete {model} {tmp}/a.png {tmp}/b.png --poses {tmp}/text --intrinsics 9,9,4,4", "--poses names 1 files"),
    ("complete {model} {tmp}/a.png {tmp}/b.ply --intrinsics 9,9,4,4", "b.ply (a cloud) were given together"),
    ("complete {model} {tmp}/a.npz {tmp}/b.ply", "observations of one world, or clouds in one frame"),
    ("complete {model}", "no input was given; give a depth image"),
    ("complete {model} --frame canonical", "0 inputs were given; give one"),
    ("complete {model} {view} {view}", "2 inputs were given; give one, or --frame input"),
    ("complete {model} {view} --seed -1", "--seed -1 was given; a number from 0"),
    ("complete {model} {silhouette} --ignore mask", "silhouette.npz: without its mask it shows nothing"),
    ("complete {model} {view} --reference {tmp}/nan.ply", "nan.ply is no mesh and no cloud of points"),
    ("complete {model} {view} --reference {tmp}/flat.ply", "its faces have no area"),
    ("complete {tmp}/missing {view}", "neither a folder nor a bundled model"),
    ("complete {model} {view} --iterations 1 --resolution 3", "resolution of 3"),
    ("pose {model} {tmp}/missing.npz", "missing.npz does not exist"),
    ("pose {model} {tmp}/empty", "empty is not an observation"),
    ("pose {model} {view} --code 7", "code 7 was given"),
    ("pose {model} {view} --code {tmp}/text", "neither the number nor the name of a training shape"),
    ("pose {model} {view} --ignore depth mask", "view.npz: without its depth and mask it shows nothing"),
    ("pose {model} {empty}", "empty.npz: it shows nothing"),
    ("pose {model} {empty} --ignore normal", "empty.npz: without its normal it shows nothing"),
    ("complete {model} {empty} --ignore normal", "empty.npz: without its normal it shows nothing"),
    ("pose {model} {view} --starts 0", "0 starts"),
    ("pose {model} {view} --azimuth 0 --distance 0", "its own place"),
    ("pose {model} {view} --elevation 5", "--elevation 5.0 --distance None were given without --azimuth"),
    ("pose {model} {view} --code {tmp}/nan.npy", "it has values that are not finite"),
    ("data furniture --from {tmp}/text", "text"),
    ("data furniture --from {tmp}/missing", "missing"),
    ("data chairs", "chairs"),
    ("sample {tmp}/missing", "is no folder of meshes"),
    ("sample {tmp}/nothing", "holds no mesh"),
    ("sample {tmp}/meshes --count 5", "--count 5"),
    ("sample {tmp}/meshes --workers 0", "--workers 0"),
    ("sample {tmp}/meshes --split {tmp}/text", "lacks the columns"),
    ("train {tmp}/missing", "is no folder of samples or meshes"),
    ("train {tmp}/good --minutes nan", "--minutes nan was given"),
    ("train {tmp}/good --save-every nan", "--save-every nan was given"),
    ("reconstruct {tmp}/good --save-every -1", "--save-every -1.0 was given"),
    ("train {tmp}/good --layers 0", "--layers 0 --width 512 were given"),
    ("train {tmp}/samples", "is not a file of samples"),
    ("train {tmp}/good --split sofas", "there is no split sofas; give a CSV file"),
    ("train {tmp}/good --out {tmp}/stopped", "is not a checkpoint of a training run"),
    ("train {tmp}/good --wrong-sign 0", "wrong_sign=0 and"),
    ("train {tmp}/good --large -1", "large=-1 were given"),
    ("train {tmp}/good --layers 2 --width 4", "each must be at least 1"),
    ("train {tmp}/good --code-length 0", "each must be at least 1"),
]


def refuses(
    words: str,
    message: str,
    place: dict[str, str],
    run: Command,
    capsys: pytest.CaptureFixture,
    program: str = "distrace",
) -> None:
    """What is wrong ends in one line that says so, and leaves no result and no empty folder."""
    arguments = tuple(word.format(**place) for word in words.split())
    out = () if "--out" in arguments or len(arguments) < 2 else ("--out", place["out"])
    assert message in one_line(run, capsys, (*arguments, *out), program=program)
    assert not (Path(place["out"]) / "result.json").exists()
    assert not Path(place["out"]).is_dir() or any(Path(place["out"]).iterdir())


@pytest.mark.parametrize(("words", "message"), BAD, ids=[words.replace("/", ".") for words, _ in BAD])
def test_whatever_is_wrong_is_one_line_and_status_two(
    words: str, message: str, place: dict[str, str], run: Command, capsys: pytest.CaptureFixture
) -> None:
    refuses(words, message, place, run, capsys)


def test_a_refused_command_removes_only_empty_folders_that_it_made(
    model: Path, run: Command, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes").write_text("")
    for out in ("made/below", "empty", "empty/below", "full", "full/below"):
        one_line(run, capsys, ("render", model, "--code", 9, "--out", tmp_path / out))
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} == {"empty", "full", "full/notes"}


def test_cuda_is_refused_where_there_is_none(
    model: Path, run: Command, capsys: pytest.CaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    said = one_line(run, capsys, ("render", model, "--device", "cuda", "--out", tmp_path))
    assert "has no CUDA; use cpu" in said


def test_ctrl_c_ends_in_one_line_and_status_130(
    model: Path, run: Command, capsys: pytest.CaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(show.Mesh, "run", interrupted)
    said = one_line(run, capsys, ("mesh", model, "--out", tmp_path), status=130)
    assert "interrupted" in said


def test_a_bug_is_not_hidden_behind_one_line(
    model: Path, run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: object) -> None:
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    monkeypatch.setattr(show.Mesh, "run", broken)
    with pytest.raises(RuntimeError, match="mat1"):
        run("mesh", model, "--out", tmp_path)


def test_names_that_look_like_markup_are_printed_as_they_are(
    model: Path, run: Command, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    for name in ("x[final]", "x[/y]z", ":smile:"):
        run("mesh", model, "--resolution", 8, "--out", tmp_path / name)
        assert f"wrote {tmp_path / name} in" in capsys.readouterr().out
    with progress("[/a]", 1) as bar:
        bar.advance("[/b] :smile:")
    assert "[/b] :smile:" in capsys.readouterr().out


def test_a_bar_is_full_where_fewer_steps_were_needed(capsys: pytest.CaptureFixture) -> None:
    with progress("fitting", 228) as bar:
        bar.advance(to=56)
    assert "56/56" in capsys.readouterr().out
    with suppress(KeyboardInterrupt), progress("fitting", 228) as bar:
        bar.advance(to=56)
        raise KeyboardInterrupt
    assert "56/228" in capsys.readouterr().out


def test_a_closed_pipe_ends_what_is_printed_not_the_command(
    model: Path, run: Command, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        monkeypatch.setattr(console, "quiet", False)  # also set back
        run("render", model, "--out", tmp_path, *VIEW)
    assert capsys.readouterr().err == ""
    assert result(tmp_path, "evaluations")["evaluations"] > 0
