"""Signed samples, their distribution and files; sampling a folder; and the splits that say what is held out."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from distrace.data import sampling
from distrace.data.samples import THIN, Doubt, doubt, lost, sample, write_samples
from distrace.data.shapes import Shape, every_mesh, read_split
from distrace.data.solid import RADIUS, SMALLEST, Solid, load_solid, normalised_frame
from distrace.fields import primitives
from distrace.training.batches import load_samples

CUBE = RADIUS / math.sqrt(3) * 2  # the edge of a normalised cube
COUNT = 5000
NEAR = 1566  # of the samples, at each deviation from the surface
COLUMNS = "name,split,design,turn,path,creator,licence"


def plain(mesh: trimesh.Trimesh) -> Solid:
    """A closed mesh is its own outer surface."""
    return Solid(mesh, mesh)


def cube() -> Solid:
    return plain(trimesh.creation.box((CUBE, CUBE, CUBE)))


def corner() -> trimesh.Trimesh:
    """An L of two boxes, another shape in the mirror."""
    arm = trimesh.creation.box((1.0, 0.5, 2.0))
    arm.apply_translation((1.5, 0, 0.5))
    return trimesh.util.concatenate([trimesh.creation.box((2.0, 0.5, 1.0)), arm])


def corner_distance(points: np.ndarray) -> np.ndarray:
    """Distance to the normalised L: exact outside."""
    middle = np.array([0.5, 0, 0.5])  # of x from -1 to 2, z from -0.5 to 1.5
    scale = RADIUS / math.hypot(1.5, 0.25, 1.0)
    parts = ((0, 0, 0), (1.0, 0.25, 0.5)), ((1.5, 0, 0.5), (0.5, 0.25, 1.0))
    at = torch.from_numpy(points.astype(np.float64) / scale + middle)
    distances = [primitives.box(torch.tensor(half).double())(at - torch.tensor(centre)) for centre, half in parts]
    return scale * torch.stack(distances).amin(0).numpy()


@pytest.fixture(scope="module")
def of_cube() -> np.ndarray:
    return sample(cube(), COUNT, seed=1)


def test_most_samples_lie_near_the_surface_at_deepsdfs_two_deviations_and_a_finer_one(of_cube: np.ndarray) -> None:
    assert of_cube.shape == (COUNT, 4)
    assert of_cube.dtype == np.float32
    for k, variance in enumerate((0.0025, 0.00025, 0.000025)):
        block = of_cube[k * NEAR : (k + 1) * NEAR]
        median = np.median(np.abs(block[:, 3])) / math.sqrt(variance)
        assert median == pytest.approx(0.6745, abs=0.06), "the median of |N(0, 1)|"


def test_the_rest_fill_the_unit_sphere_evenly(of_cube: np.ndarray) -> None:
    rest = of_cube[3 * NEAR :, :3]
    assert len(rest) == 302
    radius = np.linalg.norm(rest, axis=1)
    assert radius.max() <= 1
    assert np.mean(radius**3) == pytest.approx(0.5, abs=0.06), "the share of the volume within each is uniform"
    assert np.linalg.norm(rest.mean(0)) < 0.12


def test_distances_of_a_cube_are_exact_and_signed(of_cube: np.ndarray) -> None:
    expected = primitives.box(torch.full((3,), CUBE / 2))(torch.from_numpy(of_cube[:, :3])).numpy()
    np.testing.assert_allclose(of_cube[:, 3], expected, atol=2e-6)


def test_distances_of_a_sphere_are_right_to_its_facets() -> None:
    samples = sample(plain(trimesh.creation.icosphere(subdivisions=3, radius=0.7)), 2000, seed=2)
    np.testing.assert_allclose(samples[:, 3], np.linalg.norm(samples[:, :3], axis=1) - 0.7, atol=4e-3)


def test_a_seed_gives_the_same_samples_and_another_gives_others(of_cube: np.ndarray) -> None:
    np.testing.assert_array_equal(sample(cube(), COUNT, seed=1), of_cube)
    assert (sample(cube(), COUNT, seed=2) != of_cube).all(1).mean() > 0.99


def test_a_file_of_samples_holds_the_outside_and_the_inside_apart(of_cube: np.ndarray, tmp_path: Path) -> None:
    write_samples(tmp_path / "cube.npz", of_cube)
    with np.load(tmp_path / "cube.npz") as archive:
        pos, neg = archive["pos"], archive["neg"]
    assert pos.dtype == neg.dtype == np.float32
    assert pos.shape[1] == neg.shape[1] == 4
    assert len(pos) + len(neg) == COUNT
    assert min(len(pos), len(neg)) > COUNT / 4
    assert pos[:, 3].min() >= 0 > neg[:, 3].max()
    loaded = load_samples([tmp_path / "cube.npz"])
    np.testing.assert_array_equal(loaded.inside.parts[0].numpy(), neg)
    np.testing.assert_array_equal(loaded.outside.parts[0].numpy(), pos)


def canopy(width: float) -> trimesh.Trimesh:
    """A block with a sheet without thickness over it, drawn from both sides as cloth often is."""
    faces = [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]]
    sheet = trimesh.Trimesh([[-1, 1, -1], [1, 1, -1], [1, 1, 1], [-1, 1, 1]], faces, process=False)
    sheet.apply_scale((width, 1, width))
    return trimesh.util.concatenate([trimesh.creation.box((2, 1, 2)), sheet])


def test_what_is_seen_and_bounds_no_solid_is_measured(tmp_path: Path) -> None:
    """Rays that cross a convex body are as many as it has surface: Cauchy's theorem tells the share of a far sheet."""
    assert lost(cube()) == 0
    area = {"sheet": 2 * 4.0, "block": 16.0}  # a sheet is seen from both sides
    canopy(1.0).export(tmp_path / "canopy.ply")
    report = doubt("canopy", load_solid(tmp_path / "canopy.ply"))
    least, most = area["sheet"] / sum(area.values()) * 0.8, area["sheet"] / area["block"]
    assert least < report.lost < most, "some rays meet both, and the sheet first or the block"
    assert report.doubtful < 0.02


def test_a_mesh_that_is_mostly_sheets_is_left_out_with_the_reason(tmp_path: Path) -> None:
    canopy(3.0).export(tmp_path / "canopy.ply")
    report = doubt("canopy", load_solid(tmp_path / "canopy.ply"))
    assert not report.usable
    assert report.reason == f"{report.lost:.0%} of what is seen of it bounds no solid"
    assert report.lost > 0.7


def slabs(thickness: float) -> trimesh.Trimesh:
    """A block, whose surface is 16, below a slab of 18, and of hardly any thickness."""
    slab = trimesh.creation.box((3, thickness, 3), trimesh.transformations.translation_matrix((0, 1, 0)))
    return trimesh.util.concatenate([trimesh.creation.box((2, 1, 2)), slab])


@pytest.mark.parametrize("thickness", [0.5, 2])
def test_a_solid_that_is_mostly_a_sheet_is_left_out_with_the_reason(tmp_path: Path, thickness: float) -> None:
    _, scale = normalised_frame(slabs(1e-6))
    slabs(thickness * THIN / scale).export(tmp_path / "slabs.ply")
    report = doubt("slabs", load_solid(tmp_path / "slabs.ply"))
    assert report.lost < 0.01
    if thickness > 1:
        assert report.usable
        assert report.thin == 0
    else:
        assert report.thin == pytest.approx(18 / 34, abs=0.03)
        assert report.reason == f"{report.thin:.0%} of its surface bounds nothing thicker than 0.002"


# ---- sampling a folder: one run, with one worker, for all that follows


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Meshes: an L, once to train on and once held out, a cube, a tube open at both ends, and a file of words."""
    folder = tmp_path_factory.mktemp("sampling")
    (folder / "meshes").mkdir()
    corner().export(folder / "meshes" / "corner.ply")
    trimesh.creation.box().export(folder / "meshes" / "cube.ply")
    tube = trimesh.creation.box()
    tube.update_faces(np.abs(tube.face_normals[:, 1]) < 0.5)
    tube.export(folder / "meshes" / "tube.ply")
    (folder / "meshes" / "words.obj").write_text("no mesh at all\n")
    rows = ["left,train,corner,90,corner.ply", "cube,train,cube,0,cube.ply", "held,test,held,0,corner.ply"]
    rows += ["tube,train,tube,0,tube.ply", "words,train,words,0,words.obj"]
    (folder / "split.csv").write_text("\n".join([COLUMNS, *(f"{row},me,CC0-1.0" for row in rows)]))
    return folder


def jobs(folder: Path) -> list[sampling.Job]:
    shapes = read_split(folder / "split.csv")
    return sampling.jobs(shapes, folder / "meshes", folder / "out", 1500, mirror=True, variants=1)


@pytest.fixture(scope="module")
def reports(folder: Path) -> dict[str, Doubt]:
    return {report.name: report for report in sampling.run(jobs(folder), workers=1)}


def read(path: Path) -> np.ndarray:
    with np.load(path) as archive:
        return np.concatenate([archive["pos"], archive["neg"]]).astype(np.float64)


def test_only_shapes_to_train_on_have_variants_and_only_lopsided_ones_a_mirrored_one(
    folder: Path, reports: dict[str, Doubt]
) -> None:
    assert {path.stem for path in (folder / "out").glob("*.npz")} == {
        *("left", "left~mirrored", "left~warped1"),
        *("cube", "cube~warped1"),
        "held",
    }
    assert all(len(read(path)) == 1500 for path in (folder / "out").glob("*.npz"))


def test_a_hopeless_mesh_is_named_and_left_out(folder: Path, reports: dict[str, Doubt]) -> None:
    assert {name for name, report in reports.items() if not report.usable} == {"tube", "words"}
    assert "signs are doubtful" in reports["tube"].reason
    assert "words.obj cannot be read as a triangle mesh" in reports["words"].reason
    assert reports["cube"].reason == ""
    assert reports["cube"].outer_area == pytest.approx(1)
    stored = json.loads((folder / "out" / "tube.json").read_text())
    assert {name: value for name, value in stored.items() if name != "settings"} == asdict(reports["tube"])


def test_samples_are_of_the_shape_turned_to_the_orientation_of_its_class(
    folder: Path, reports: dict[str, Doubt]
) -> None:
    samples = read(folder / "out" / "left.npz")
    x, y, z = samples[:, :3].T
    expected = corner_distance(np.stack([-z, y, x], axis=1))  # a quarter turn about y brings (x, y, z) to (z, y, -x)
    outside = samples[:, 3] > 0
    np.testing.assert_allclose(samples[outside, 3], expected[outside], atol=SMALLEST)
    assert (expected[~outside] < 1e-3).all()


def test_the_mirrored_variant_is_of_the_mirror_image(folder: Path, reports: dict[str, Doubt]) -> None:
    held = load_solid(folder / "meshes" / "corner.ply")
    mirrored = read(folder / "out" / "left~mirrored.npz")
    x, y, z = mirrored[:, :3].T
    turned_back = np.stack([-z, y, -x], axis=1)  # the mirror in x, then the quarter turn back
    clear = np.abs(mirrored[:, 3]) > 1e-3
    np.testing.assert_allclose(mirrored[clear, 3], held.distance(turned_back)[clear], atol=1e-5)
    there = np.abs(held.distance(np.stack([-z, y, x], axis=1)) - mirrored[:, 3])
    assert there.max() > 0.1, "the L itself is another shape"


def test_a_second_run_rewrites_nothing_and_reports_the_same(folder: Path, reports: dict[str, Doubt]) -> None:
    before = {path: path.stat().st_mtime_ns for path in (folder / "out").iterdir()}
    assert {report.name: report for report in sampling.run(jobs(folder), workers=1)} == reports
    assert {path: path.stat().st_mtime_ns for path in (folder / "out").iterdir()} == before


def test_a_run_that_was_stopped_goes_on_with_what_is_missing(folder: Path, reports: dict[str, Doubt]) -> None:
    """The report is written last: a shape without one is done again, and comes out the same."""
    cube_file, report = folder / "out" / "cube.npz", folder / "out" / "cube.json"
    samples = read(cube_file)
    report.unlink()
    cube_file.unlink()
    (job,) = (job for job in jobs(folder) if sampling._earlier(job) is None)
    assert sampling.run_one(job) == reports["cube"]
    np.testing.assert_array_equal(read(cube_file), samples)


def test_samples_of_another_mesh_or_other_settings_are_not_taken_for_these(
    folder: Path, reports: dict[str, Doubt], tmp_path: Path
) -> None:
    (job,) = (job for job in jobs(folder) if job.shape.name == "cube")
    with pytest.raises(ValueError, match="has samples of cube with another count, variants; give another --out"):
        list(sampling.run([replace(job, count=2000, variants=2)], workers=1))
    with pytest.raises(ValueError, match="has samples of cube with another mesh;"):
        list(sampling.run([replace(job, mesh=folder / "meshes" / "corner.ply")], workers=1))
    damaged = replace(job, out=tmp_path)
    damaged.report.write_text("[]")
    with pytest.raises(ValueError, match=r"cube.json is not what `sample` leaves of a shape; remove it"):
        list(sampling.run([damaged], workers=1))


@pytest.mark.parametrize(
    "tampered",
    [{"settings": "mesh"}, {"settings": 3}, {"usable": "yes"}, {"name": 7}, {"name": "other"}, {"lost": "0"}],
    ids=str,
)
def test_a_report_with_values_of_other_kinds_ends_in_one_sentence(
    folder: Path, reports: dict[str, Doubt], tmp_path: Path, tampered: dict
) -> None:
    (job,) = (job for job in jobs(folder) if job.shape.name == "cube")
    content = json.loads(job.report.read_text())
    damaged = replace(job, out=tmp_path)
    damaged.report.write_text(json.dumps(content | tampered))
    with pytest.raises(ValueError, match=r"cube.json is not what `sample` leaves of a shape; remove it"):
        list(sampling.run([damaged], workers=1))


def test_a_shape_whose_samples_are_gone_is_sampled_anew(folder: Path, reports: dict[str, Doubt]) -> None:
    (job,) = (job for job in jobs(folder) if job.shape.name == "cube")
    before = read(job.samples())
    job.samples().unlink()
    assert list(sampling.run([job], workers=1)) == [reports["cube"]]
    np.testing.assert_array_equal(read(job.samples()), before)


# ---- splits


def test_a_split_may_have_more_columns(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(f"{COLUMNS},colour\nchair,train,chair,-90,a/chair.obj,me,CC0-1.0,red\n")
    assert read_split(path) == [Shape("chair", "train", "chair", -90.0, "a/chair.obj", "me", "CC0-1.0")]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no split"),
        (b"name,split\na,train\n", "lacks the columns design, turn, path, creator, licence"),
        (f"{COLUMNS}\nchair,train\n".encode(), "cannot be read"),
        (f"{COLUMNS}\nchair,train,chair,left,a.obj,me,CC0-1.0\n".encode(), "cannot be read"),
        (b"\xff\xfe\x00\x01", "cannot be read"),
        (f"{COLUMNS}\nchair,train,chair,nan,a.obj,me,CC0-1.0\n".encode(), "the turn nan"),
        (f"{COLUMNS}\nchair,trian,chair,0,a.obj,me,CC0-1.0\n".encode(), "the side 'trian'"),
        (f"{COLUMNS}\n../chair,train,chair,0,a.obj,me,CC0-1.0\n".encode(), "cannot name its files; rename it"),
        (f"{COLUMNS}\nresult,train,chair,0,a.obj,me,CC0-1.0\n".encode(), "cannot name its files; rename it"),
        (f"{COLUMNS}\na,train,a,0,a.obj,me,CC0\na,test,b,0,b.obj,me,CC0\n".encode(), "2 shapes are called a"),
    ],
    ids=["missing", "columns", "short", "turn", "binary", "nan", "side", "outside", "reserved", "twice"],
)
def test_a_split_that_cannot_be_read_ends_in_one_sentence(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "mine.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_split(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_mesh_below_a_folder_is_named_by_its_path(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no mesh"):
        every_mesh(tmp_path)
    for name in ("b/chair.OBJ", "a/chair.ply", "a/readme.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    shapes = every_mesh(tmp_path)
    assert [shape.name for shape in shapes] == ["a-chair", "b-chair"]
    assert [shape.path for shape in shapes] == ["a/chair.ply", "b/chair.OBJ"]
    assert {shape.split for shape in shapes} == {"train"}
    (tmp_path / "a" / "chair.obj").write_text("")
    with pytest.raises(ValueError, match=r"2 shapes are called a-chair \(a/chair.obj, a/chair.ply\); rename or remove"):
        every_mesh(tmp_path)
