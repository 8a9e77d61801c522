"""Products in bfloat16: as right as a fit can tell, and only where the processor has them."""

from dataclasses import replace

import pytest
import torch

import distrace.fields.precision
from distrace.checkpoints.model import load_model
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.fields.precision import ROWS, BFloat16Decoder, PackedDecoder, fastest
from distrace.fitting.code_jacobian import derivatives


@pytest.fixture(scope="module")
def model():
    return load_model("sofas")


PACKS = pytest.mark.skipif(
    not torch.ops.mkldnn._is_mkldnn_bf16_supported(), reason="this processor cannot multiply packed bfloat16 weights"
)


@pytest.fixture(params=[BFloat16Decoder, pytest.param(PackedDecoder, marks=PACKS)])
def form(request):
    return request.param


def test_near_the_surface_rounding_is_not_seen(model, form) -> None:
    exact, rounded = model.field(0), form(model.decoder).field(model.codes[0])
    points = 1.6 * torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) - 0.8
    with torch.no_grad():
        values = exact(points)
        near = values.abs() < 0.02
        off = (rounded(points[near]) - values[near]).abs()
    assert near.sum() > 500
    assert 0 < off.mean() < 3e-4
    assert off.max() < 5e-3


def test_both_ways_to_ask_agree(model, form) -> None:
    rounded, points = form(model.decoder), torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    with torch.no_grad():
        one, other = rounded(points, model.codes[:1]), rounded.field(model.codes[0])(points)
    assert one.dtype == other.dtype == torch.float32
    torch.testing.assert_close(one, other, atol=2e-3, rtol=0)


@pytest.mark.parametrize("count", [0, 1, ROWS - 1, ROWS, ROWS + 1, 3 * ROWS])
def test_rows_that_fill_up_a_batch_are_not_seen(model, form, count: int) -> None:
    points = torch.rand(3 * ROWS, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    field = form(model.decoder).field(model.codes[0])
    assert field(points[:count]).shape == (count,)
    torch.testing.assert_close(field(points[:count]), field(points)[:count], atol=2e-3, rtol=0)


@pytest.mark.parametrize("shape", [(), (5,), (5, 7), (2, 0, 3)])
def test_points_come_in_any_shape(model, form, shape: tuple[int, ...]) -> None:
    points = torch.rand(*shape, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    field = form(model.decoder).field(model.codes[0])
    assert field(points).shape == shape
    assert torch.equal(field(points).reshape(-1), field(points.reshape(-1, 3)))


def test_several_shapes_are_answered_as_each_alone(model, form) -> None:
    rounded = form(model.decoder)
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(4)) - 0.5
    counts = [5, 200, 0, 95]
    field = rounded.field(model.codes[:4])
    values = field.select(torch.arange(4).repeat_interleave(torch.tensor(counts)))(points)
    for code, part, answer in zip(model.codes, points.split(counts), values.split(counts)):
        assert torch.equal(answer, rounded.field(code)(part))


def test_a_batch_is_the_field_of_each_of_its_shapes(model, form) -> None:
    rounded = form(model.decoder)
    field, points = rounded.field(model.codes[:3]), torch.rand(3, 40, 2, 3, generator=torch.manual_seed(6)) - 0.5
    assert len(field) == 3
    assert torch.equal(field.codes, model.codes[:3])
    for b, values in enumerate(field(points)):
        torch.testing.assert_close(field[b](points[b]), values, atol=2e-3, rtol=0)
        assert torch.equal(field[b](points[b]), rounded.field(model.codes[b])(points[b]))


def test_more_points_of_several_shapes_than_a_chunk_are_as_good_as_few(model, form, monkeypatch) -> None:
    field, points = (
        form(model.decoder).field(model.codes[:2]),
        torch.rand(2, 50, 3, generator=torch.manual_seed(7)) - 0.5,
    )
    whole = field(points)
    monkeypatch.setattr("distrace.fields.precision.CHUNK", 32)
    torch.testing.assert_close(field(points), whole, atol=2e-3, rtol=0)


def test_a_batch_of_codes_of_another_length_is_refused(model, form) -> None:
    with pytest.raises(ValueError, match=r"a code of shape \[3, 7\] was given; this decoder takes \[shapes, 256\]$"):
        form(model.decoder).field(torch.zeros(3, 7))


@PACKS
def test_packed_weights_are_as_right_as_autocast(model) -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(5)) - 0.5
    exact = model.field(1)(points)
    found, usual = (
        form(model.decoder).field(model.codes[1])(points) - exact for form in (PackedDecoder, BFloat16Decoder)
    )
    torch.testing.assert_close(found, usual, atol=2e-3, rtol=0)
    assert 0 < found.square().mean() < 1.1 * usual.square().mean()


@PACKS
@pytest.mark.parametrize("use_tanh", [False, True])
@pytest.mark.parametrize("latent_in", [(), (2,), (1, 3)])
def test_slopes_are_those_of_autograd(latent_in: tuple[int, ...], use_tanh: bool) -> None:
    torch.manual_seed(0)
    specs = NetworkSpecs((64,) * 4, 8, latent_in, norm_layers=(0, 1), use_tanh=use_tanh)
    decoder = Decoder(specs).eval().requires_grad_(False)
    points, code = torch.rand(77, 3) - 0.5, torch.randn(8)
    assert PackedDecoder.has(decoder)
    exact, quick = derivatives(decoder, points, code), derivatives(PackedDecoder(decoder), points, code)
    torch.testing.assert_close(quick[0], exact[0], atol=1e-6, rtol=1e-5)
    for found, true in zip(quick[1:], exact[1:], strict=True):
        assert found.shape == true.shape
        assert (found - true).norm() < 0.01 * true.norm()


@pytest.mark.parametrize(
    "specs", [{"weight_norm": False}, {"xyz_in_all": True, "norm_layers": ()}, {"latent_in": (2, 4)}]
)
def test_other_layers_are_run_as_they_are(specs: dict) -> None:
    torch.manual_seed(0)
    decoder = Decoder(replace(NetworkSpecs((64,) * 4, 8, (2,)), **specs)).eval().requires_grad_(False)
    points, code, rounded = torch.rand(50, 3) - 0.5, torch.randn(8), BFloat16Decoder(decoder)
    assert not PackedDecoder.has(decoder)
    torch.testing.assert_close(rounded.field(code)(points), decoder.field(code)(points), atol=2e-2, rtol=0)
    for found, true in zip(derivatives(rounded, points, code), derivatives(decoder, points, code), strict=True):
        assert torch.equal(found, true)


@pytest.mark.parametrize(("capabilities", "kind"), [({"avx512_bf16": True}, PackedDecoder), ({"avx2": True}, None)])
def test_only_a_processor_that_multiplies_so_is_asked_to(model, monkeypatch, capabilities, kind) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    distrace.fields.precision._multiplies_in_bfloat16.cache_clear()
    try:
        assert type(fastest(model.decoder)) is (kind or type(model.decoder))
    finally:
        distrace.fields.precision._multiplies_in_bfloat16.cache_clear()


def test_doubles_stay_doubles(model) -> None:
    double = type(model.decoder)(model.decoder.specs).double()
    assert fastest(double) is double
