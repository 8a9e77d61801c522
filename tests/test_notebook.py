"""What Jupyter shows of results: pictures of buffers, tables of models and fits."""

from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

import distrace as dt
from distrace.checkpoints.model import Model
from distrace.fields.batch import BatchField
from distrace.fitting.fit_code import CodeFit
from distrace.fitting.fit_scan import ScanFit
from distrace.fitting.judge import Verdict
from distrace.pose import Similarity
from distrace.render import Buffers, render_rays


def ball(height: int, width: int) -> Buffers:
    return dt.render(dt.primitives.sphere(0.5), dt.Camera.orbit(20, 10, 4, height=height, width=width))


def picture(buffers: Buffers) -> np.ndarray:
    png = buffers._repr_png_()
    assert png is not None
    return np.array(Image.open(BytesIO(png)))


def test_buffers_show_shading_normals_and_depth_in_a_row() -> None:
    strip = picture(ball(48, 64))
    assert strip.shape == (48, 3 * 64, 3)
    middles = strip[24, 32::64].astype(int)
    assert (middles.min(1) < 250).all()  # the ball is in the middle of all three
    assert np.abs(middles - np.roll(middles, 1, axis=0)).max(1).min() > 20  # and they differ
    assert (strip[0] == 255).all()


def test_a_large_image_is_shown_small() -> None:
    strip = picture(ball(300, 600))
    assert strip.shape == (100, 3 * 200, 3)


def test_of_a_batch_the_first_views_are_shown_each_with_its_own_shape() -> None:
    camera = dt.Camera.orbit(torch.zeros(4), 0, 4, height=32, width=32)
    radii = torch.tensor([[0.3], [0.5], [0.4], [0.6]])
    balls = BatchField(radii, lambda points, shape: points.norm(dim=-1) - radii[shape, 0], dt.primitives.sphere)
    strip = picture(dt.render(balls, camera))
    assert strip.shape == (3 * 32, 3 * 32, 3)
    covered = (strip[:, :32] < 255).any(-1).reshape(3, -1).sum(1)
    assert covered[0] < covered[2] < covered[1]


def test_an_empty_image_and_single_rays_are_shown_too() -> None:
    camera = dt.Camera.orbit(0, 0, 4, height=16, width=16)
    assert (picture(dt.render(lambda points: points.norm(dim=-1) + 1, camera)) == 255).all()
    assert render_rays(dt.primitives.sphere(0.5), camera, torch.tensor([[8.0, 8.0]]))._repr_png_() is None


def test_a_picture_costs_no_gradients_and_keeps_no_graph() -> None:
    radius = torch.tensor(0.5, requires_grad=True)
    buffers = dt.render(dt.primitives.sphere(radius), dt.Camera.orbit(0, 0, 4, height=16, width=16))
    picture(buffers)
    assert not buffers.images
    buffers.depth[buffers.mask].sum().backward()
    assert radius.grad is not None


def test_a_model_shows_its_network_and_its_first_shapes() -> None:
    model = dt.load_model("sofas")
    shown = Model("<mine>", model.decoder, model.codes[:8], tuple("abcdefgh"))._repr_html_()
    assert "&lt;mine&gt;" in shown
    assert "<td>8 × 512</td>" in shown
    assert "<td>a, b, c, d, e, f, …</td>" in shown


@pytest.mark.parametrize("kind", ["code", "scan"])
def test_a_fit_shows_its_loss_its_cost_and_its_verdict(kind: str) -> None:
    code = torch.zeros(4)
    if kind == "code":
        shown = CodeFit(code, 0.123456, {}, 1_234_567, 2.5)._repr_html_()
    else:
        verdict = Verdict("doubtful", 0.9, 0.0, 0.4, 0.0, None, None, "10 % of the points lie away & apart")
        shown = ScanFit(code, Similarity.identity(), 0.123456, verdict, {}, 1_234_567, 2.5, ())._repr_html_()
        assert "<td>doubtful: 10 % of the points lie away &amp; apart</td>" in shown
    assert all(f"<td>{fact}</td>" in shown for fact in ("0.1235", "1,234,567", "2.5"))
