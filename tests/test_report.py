"""The page of a completion, read back as a browser would."""

import base64
import gzip
import io
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from plotly.offline import get_plotlyjs

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.fields.primitives import sphere
from distrace.fitting.judge import Verdict
from distrace.metrics import Chamfer
from distrace.render import render
from distrace.report import charts, scene
from distrace.report import page as html
from distrace.report.completion_page import Completion, RenderedView, completion_page
from distrace.report.scan_page import ORANGE, input_picture

VOID = {"meta", "link", "img", "br", "path", "use"}


class Reader(HTMLParser):
    """Tags with their attributes, the text between them, the contents of scripts; fails where tags do not close."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.text, self.scripts, self.open = "", [], []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attributes}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attributes}))

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, text: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts.append(text)
        elif self.open and self.open[-1] != "style":
            self.text += text + "\n"

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]


def view(radius: float) -> RenderedView:
    with torch.no_grad():
        camera = Camera.orbit(30, 20, 4.0, height=48, width=48)
        return RenderedView.of(render(sphere(radius), camera), camera)


@pytest.fixture(scope="module")
def completion() -> Completion:
    before, after, truth = view(0.8), view(0.62), view(0.6)
    depth = np.full((48, 48), np.inf, dtype=np.float32)
    depth[20:28:3, 20:28:3] = truth.depth[20:28:3, 20:28:3]
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.62)
    points = np.asarray(mesh.vertices)
    return Completion(
        verdict=Verdict("trusted", 0.99, 0.0, 0.9, 0.0, 0.97, 0.4, "99% of the points lie on the surface"),
        title="Sphere <b>&</b> co",
        observed_depth=depth,
        observed_mask=truth.mask,
        points_world=points[:9],
        before=before,
        after=after,
        truth=truth,
        losses={"start 1": [1.0, 0.5], "start 2": [0.9, 0.1, 0.01]},
        mesh=mesh,
        truth_surface=points * 0.6 / 0.62,
        chamfer=Chamfer(to=0.1234, from_=0.5678),
        facts={"model": "<script>alert(1)</script>", "seconds": "12.5"},
        chosen="start 2",
        origin="model <i>balls</i> · distrace complete · distrace 1.2",
    )


@pytest.fixture(scope="module")
def page(completion: Completion) -> str:
    return completion_page(completion)


@pytest.fixture(scope="module")
def read(page: str) -> Reader:
    return Reader(page)


def scene_of(read: Reader) -> dict:
    return json.loads(next(script for script in read.scripts if script.startswith("{")))


def test_every_tag_that_opens_closes(read: Reader) -> None:
    assert read.open == []


def test_the_page_refers_to_nothing_outside_itself(read: Reader) -> None:
    for tag, attributes in read.tags:
        for name in ("src", "href", "xlink:href", "srcset", "action", "data"):
            assert attributes.get(name, "data:").startswith(("data:", "#")), (tag, name)
        assert "url(http" not in attributes.get("style", "")
    own = [script for script in read.scripts if len(script) < 1_000_000]
    assert own
    assert not any(re.search(r"https?://", script) for script in own)


def test_the_page_forbids_the_browser_to_load_anything(read: Reader) -> None:
    policy = next(tag["content"] for tag in read.all("meta") if tag.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy
    assert "http" not in policy


def test_what_the_user_wrote_is_text_and_not_markup(page: str, read: Reader) -> None:
    assert "Sphere <b>&</b> co" in read.text
    assert "<script>alert(1)</script>" in read.text
    assert "<script>alert" not in page
    assert not read.all("b")


def test_markup_in_captions_cells_and_names_of_curves_and_clouds_stays_text() -> None:
    evil = '"><script>alert("$x")</script>'
    mesh = trimesh.creation.icosphere(subdivisions=1)
    blocks = [
        html.figure(np.zeros((2, 2, 3), np.uint8), evil),
        html.table((evil,), [(evil,)]),
        charts.curves({evil: [1.0, 2.0]}, evil, evil, log=False, emphasised=evil),
        scene.scene({evil: mesh}, {evil: np.zeros((1, 3))}),
        html.key({evil: (0, 0, 0)}),
        html.paragraph(evil),
        html.section(evil),
    ]
    for block in blocks:
        assert "<script>alert" not in block
        Reader(block)


def test_each_part_has_its_heading(read: Reader) -> None:
    for part in (
        "Observed",
        "Shape",
        "In space",
        "Distance to the truth",
        "Silhouettes",
        "Depth",
        "Normals",
        "Loss",
        "Facts",
    ):
        assert f"\n{part}\n" in read.text, part


def test_every_picture_is_a_png_with_a_caption(read: Reader) -> None:
    pictures = read.all("img")
    assert len(pictures) == 2 + 3 + 2 + 3 + 2 + 3
    for picture in pictures:
        encoded = picture["src"].removeprefix("data:image/png;base64,")
        image = Image.open(io.BytesIO(base64.b64decode(encoded)))
        assert image.size == (int(picture["width"]), int(picture["height"]))
        assert picture["alt"] in read.text


def test_both_directions_of_the_chamfer_distance_are_told_with_their_unit(read: Reader) -> None:
    for words in ("0.1234", "0.5678", "0.6912", "× 1000", "30,000 points", "surface is missing", "should not be there"):
        assert words in read.text, words


def test_the_curves_have_their_names_and_the_chosen_start_is_told(read: Reader) -> None:
    assert "start 1" in read.text
    assert "Bold: start 2, the start with the least loss at the end" in read.text
    assert len(read.all("svg")) == 1


def test_the_axes_of_curves_take_the_colour_of_the_page() -> None:
    drawn = charts.curves({"a": [1.0, 2.0]}, "step", "loss", log=True)
    assert "currentColor" in drawn
    assert charts.THEME_INK not in drawn


def test_the_scene_holds_the_surface_the_observed_points_and_the_truth(read: Reader, completion: Completion) -> None:
    surface, observed, truth = scene_of(read)["data"]
    assert [surface["type"], observed["type"], truth["type"]] == ["mesh3d", "scatter3d", "scatter3d"]
    up = np.frombuffer(base64.b64decode(observed["z"]["bdata"]), observed["z"]["dtype"])  # plotly's z is up
    assert np.allclose(up, completion.points_world[:, 1])


def test_plotly_is_inlined_once_and_only_where_something_turns(read: Reader) -> None:
    (packed,) = (script for script in read.scripts if len(script) > 1_000_000)
    assert gzip.decompress(base64.b64decode(packed)).decode() == get_plotlyjs()
    still = html.page("Still", "No view", [html.section("Table", html.table(("a",), [("1",)]))])
    assert len(still) < 10_000
    assert not Reader(still).scripts


def test_a_true_mesh_is_a_surface_that_the_legend_shows(completion: Completion) -> None:
    truth = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    completed, true, observed = scene_of(Reader(completion_page(replace(completion, truth_surface=truth))))["data"]
    assert [each["type"] for each in (completed, true, observed)] == ["mesh3d", "mesh3d", "scatter3d"]
    assert true["name"] == "True surface"
    assert true["visible"] == "legendonly"
    assert "visible" not in completed
    assert true["color"] != completed["color"]


def test_the_page_says_what_made_it(page: str, read: Reader) -> None:
    assert "model <i>balls</i> · distrace complete · distrace 1.2" in read.text
    assert "<i>balls" not in page


def test_a_page_of_a_fine_mesh_stays_small(completion: Completion) -> None:
    fine = trimesh.creation.icosphere(subdivisions=6, radius=0.62)
    assert len(completion_page(replace(completion, mesh=fine))) < 2_700_000


def test_a_page_without_truth_or_silhouette_leaves_out_what_it_cannot_know(completion: Completion) -> None:
    unknown = replace(completion, truth=None, truth_surface=None, chamfer=None, observed_mask=None, chosen=None)
    read = Reader(completion_page(unknown))
    assert "Distance to the truth" not in read.text
    assert "Truth" not in read.text
    assert len(scene_of(read)["data"]) == 2
    assert read.open == []


def test_a_dense_observation_is_shown_as_depth_and_a_sparse_one_as_dots(completion: Completion) -> None:
    dense = replace(completion, observed_depth=completion.after.depth)
    assert "The observed depth" in Reader(completion_page(dense)).text
    assert "The observed points, over" in Reader(completion_page(completion)).text


def test_a_mesh_of_many_faces_is_thinned_but_keeps_its_form() -> None:
    fine = trimesh.creation.icosphere(subdivisions=6, radius=0.7)
    assert len(fine.faces) > scene.MOST_FACES
    surface = Reader(scene.scene({"fine": fine}, {}))
    drawn = json.loads(surface.scripts[0])["data"][0]
    i = np.frombuffer(base64.b64decode(drawn["i"]["bdata"]), drawn["i"]["dtype"])
    corners = np.stack([np.frombuffer(base64.b64decode(drawn[axis]["bdata"]), np.float32) for axis in "xyz"], axis=1)
    assert 10_000 < len(i) <= scene.MOST_FACES
    assert np.abs(np.linalg.norm(corners, axis=1) - 0.7).max() < 0.01


def test_the_input_of_a_scan_is_grey_with_its_object_coloured_in_a_frame() -> None:
    image = torch.linspace(2.0, 4.0, 1000)[:, None].expand(1000, 1300).clone()
    image[:, :90] = torch.inf
    alone = torch.full_like(image, torch.inf)
    alone[300:600, 450:900] = image[300:600, 450:900]
    camera = Camera.orbit(30, 20, 3.0, height=1000, width=1300)
    picture = input_picture(image, View(camera, alone))
    assert max(picture.shape) <= 640
    scale = picture.shape[1] / 1300
    grey = picture.max(-1) == picture.min(-1)
    top, bottom, left, right = (round(scale * edge) for edge in (300, 600, 450, 900))
    assert not grey[top + 2 : bottom - 2, left + 2 : right - 2].any(), "the object"
    assert (picture[bottom + 1, left + 9 : right - 9] == ORANGE).all(), "the frame"
    assert grey[: top - 5].all()
    assert (picture[:, : round(scale * 90) - 2] == 255).all(), "no depth"
    assert picture[: top - 5, left:].min() > 130, "pale"
    nothing = input_picture(image, View(camera, torch.full_like(image, torch.inf)))
    assert (nothing.max(-1) == nothing.min(-1)).all()


def test_columns_of_numbers_stand_to_the_right_and_columns_with_words_to_the_left() -> None:
    drawn = Reader(html.table(("name", "value", "note"), [("chair", "0.25", "7"), ("sofa", "–", "seven")]))
    assert [cell.get("class") for cell in drawn.all("td")] == [None, "number", None] * 2
    assert [cell.get("class") for cell in drawn.all("th")] == [None, "number", None]


def test_a_scene_keeps_the_colours_of_vertices_where_there_are_some() -> None:
    ball = trimesh.creation.icosphere(6)
    assert len(ball.faces) > scene.MOST_FACES
    assert "vertexcolor" not in str(scene.scene({"ball": ball}, {}))
    painted = trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=[255, 0, 128], process=False)
    assert '"vertexcolor":["#ff0080","#ff0080"' in str(scene.scene({"ball": painted}, {}))


@pytest.mark.parametrize("sides", [(1, 1, 1), (0.4, 2, 0.4), (0.4, 0.4, 4), (2, 0.5, 2), (1, 0, 0)])
def test_all_of_a_scene_is_in_its_picture_and_fills_it(sides: tuple[float, float, float]) -> None:
    corners = np.array(trimesh.creation.box(np.maximum(sides, 1e-9)).vertices) + 5.0
    eye = json.loads(Reader(scene.scene({}, {"corners": corners})).scripts[0])["layout"]["scene"]["camera"]["eye"]
    unit = np.prod(np.maximum(sides, 0.01 * max(sides))) ** (1 / 3)
    at = torch.tensor([eye["y"], eye["z"], eye["x"]]) * unit + 5.0
    camera = Camera.look_at(at, torch.full((3,), 5.0), height=100, width=150, focal_px=50 / math.tan(math.pi / 8))
    pixels = camera.project(torch.from_numpy(corners).float())[0]
    from_middle = (pixels / torch.tensor([75.0, 50.0]) - 1).abs().max()
    assert 0.8 < from_middle < 1


def test_a_scene_of_nothing_is_a_scene() -> None:
    assert Reader(scene.scene({}, {"nothing": np.empty((0, 3))})).scripts
