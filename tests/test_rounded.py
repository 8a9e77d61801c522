"""Products in bfloat16: as right as a fit can tell, and only where the processor has them."""

import pytest
import torch

import distrace.rounded
from distrace.checkpoint import load_model
from distrace.rounded import ROWS, Rounded, quickest


@pytest.fixture(scope="module")
def model():
    return load_model("sofas")


def test_near_the_surface_rounding_is_not_seen(model) -> None:
    exact, rounded = model.field(0), Rounded(model.decoder).field(model.codes[0])
    points = 1.6 * torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) - 0.8
    with torch.no_grad():
        values = exact(points)
        near = values.abs() < 0.02
        off = (rounded(points[near]) - values[near]).abs()
    assert near.sum() > 500
    assert 0 < off.mean() < 3e-4
    assert off.max() < 5e-3


def test_both_ways_to_ask_agree(model) -> None:
    rounded, points = Rounded(model.decoder), torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    with torch.no_grad():
        one, other = rounded(points, model.codes[:1]), rounded.field(model.codes[0])(points)
    assert one.dtype == other.dtype == torch.float32
    torch.testing.assert_close(one, other, atol=2e-3, rtol=0)


@pytest.mark.parametrize("count", [0, 1, ROWS - 1, ROWS, ROWS + 1, 3 * ROWS])
def test_rows_that_fill_up_a_batch_are_not_seen(model, count: int) -> None:
    points = torch.rand(3 * ROWS, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    field = Rounded(model.decoder).field(model.codes[0])
    assert field(points[:count]).shape == (count,)
    torch.testing.assert_close(field(points[:count]), field(points)[:count], atol=2e-3, rtol=0)


@pytest.mark.parametrize("shape", [(), (5,), (5, 7), (2, 0, 3)])
def test_points_come_in_any_shape(model, shape: tuple[int, ...]) -> None:
    points = torch.rand(*shape, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    field = Rounded(model.decoder).field(model.codes[0])
    assert field(points).shape == shape
    assert torch.equal(field(points).reshape(-1), field(points.reshape(-1, 3)))


@pytest.mark.parametrize(("capabilities", "kind"), [({"avx512_bf16": True}, Rounded), ({"avx2": True}, None)])
def test_only_a_processor_that_multiplies_so_is_asked_to(model, monkeypatch, capabilities, kind) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    distrace.rounded._multiplies_in_bfloat16.cache_clear()
    try:
        assert type(quickest(model.decoder)) is (kind or type(model.decoder))
    finally:
        distrace.rounded._multiplies_in_bfloat16.cache_clear()


def test_doubles_stay_doubles(model) -> None:
    double = type(model.decoder)(model.decoder.specs).double()
    assert quickest(double) is double
