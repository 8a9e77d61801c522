"""The decoder, against DeepSDF's forward pass written out in numpy (Park et al., CVPR 2019, and their own code)."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch.func import functional_call

from distrace.fields.base import chunked
from distrace.fields.decoder import Decoder, NetworkSpecs, ShapeField
from experiments.costs.counting import Operations

torch.set_num_threads(1)

PLAIN = NetworkSpecs(dims=(16, 17, 18, 19), code_length=5, latent_in=(2,), norm_layers=(0, 1, 2, 3))
ARCHITECTURES = {
    "as published": NetworkSpecs(dims=(24,) * 8, code_length=6, latent_in=(4,), norm_layers=tuple(range(8))),
    "fed again at the last layer": NetworkSpecs(dims=(16, 16, 20), code_length=4, latent_in=(3,)),
    "fed again twice": NetworkSpecs(dims=(16, 16, 20, 16), code_length=4, latent_in=(1, 3)),
    "never fed again": NetworkSpecs(dims=(16, 16), code_length=4, latent_in=()),
    "points in all layers": NetworkSpecs(dims=(16,) * 4, code_length=3, latent_in=(2,), xyz_in_all=True),
    "two tanh": NetworkSpecs(dims=(16,) * 3, code_length=3, latent_in=(2,), use_tanh=True),
    "layer norm": NetworkSpecs(dims=(16,) * 3, code_length=3, latent_in=(2,), norm_layers=(0, 2, 3), weight_norm=False),
    "no norm": NetworkSpecs(dims=(16,) * 3, code_length=3, latent_in=(1,), norm_layers=(), weight_norm=False),
    "weight norm on some": NetworkSpecs(dims=(16,) * 4, code_length=3, latent_in=(), norm_layers=(0, 2)),
    "a single number as code": NetworkSpecs(dims=(16,) * 3, code_length=1, latent_in=(2,)),
    "linear": NetworkSpecs(dims=(), code_length=2, latent_in=()),
}


def deepsdf(specs: NetworkSpecs, state: dict[str, np.ndarray], code: np.ndarray, points: np.ndarray) -> np.ndarray:
    """DeepSDF's own forward, point by point: code and point concatenated, nothing folded."""
    given = np.concatenate([np.broadcast_to(code, (len(points), len(code))), points], axis=1)
    x = given
    last = len(specs.dims)
    for layer in range(last + 1):
        if layer in specs.latent_in:
            x = np.concatenate([x, given], axis=1)
        elif layer != 0 and specs.xyz_in_all:
            x = np.concatenate([x, points], axis=1)
        x = x @ layer_weight(state, layer).T + state[f"lin{layer}.bias"]
        if layer == last and specs.use_tanh:
            x = np.tanh(x)
        if layer < last:
            if layer in specs.norm_layers and not specs.weight_norm:
                centred = x - x.mean(axis=1, keepdims=True)
                x = centred / np.sqrt((centred**2).mean(axis=1, keepdims=True) + 1e-5)
                x = x * state[f"bn{layer}.weight"] + state[f"bn{layer}.bias"]
            x = np.maximum(x, 0)
    return np.tanh(x)[:, 0]


def layer_weight(state: dict[str, np.ndarray], layer: int) -> np.ndarray:
    if f"lin{layer}.weight" in state:
        return state[f"lin{layer}.weight"]
    v = state[f"lin{layer}.parametrizations.weight.original1"]
    return state[f"lin{layer}.parametrizations.weight.original0"] * v / np.linalg.norm(v, axis=1, keepdims=True)


def randomised(specs: NetworkSpecs, seed: int = 0) -> Decoder:
    """In float64 and eval mode, every parameter drawn: also those that start as ones and zeros."""
    torch.manual_seed(seed)
    decoder = Decoder(specs).double().eval()
    for name, parameter in decoder.named_parameters():
        deviation = parameter.shape[1] ** -0.5 if parameter.dim() == 2 and parameter.shape[1] > 1 else 0.5
        around = 1.0 if name.endswith("original0") or name.startswith("bn") else 0.0
        torch.nn.init.normal_(parameter, mean=around, std=deviation)
    return decoder


def arrays(decoder: Decoder) -> dict[str, np.ndarray]:
    return {key: value.numpy() for key, value in decoder.state_dict().items()}


@pytest.fixture(params=ARCHITECTURES, ids=lambda name: name.replace(" ", "-"))
def decoder(request) -> Decoder:
    return randomised(ARCHITECTURES[request.param])


@pytest.fixture
def points() -> torch.Tensor:
    return torch.rand(40, 3, dtype=torch.float64, generator=torch.manual_seed(1)) * 2 - 1


def a_code(decoder: Decoder, *batch: int) -> torch.Tensor:
    return torch.randn(*batch, decoder.specs.code_length, dtype=torch.float64, generator=torch.manual_seed(2))


def test_the_folded_field_is_deepsdf_s_forward(decoder, points):
    code = a_code(decoder)
    expected = deepsdf(decoder.specs, arrays(decoder), code.numpy(), points.numpy())
    assert expected.std() > 1e-3
    np.testing.assert_allclose(decoder.field(code)(points).detach(), expected, atol=1e-12)


def test_forward_with_a_code_per_point_is_each_field_at_its_point(decoder, points):
    codes = a_code(decoder, len(points))
    each = [decoder.field(code)(point[None]) for code, point in zip(codes, points)]
    torch.testing.assert_close(decoder(points, codes), torch.cat(each))


def test_forward_with_a_code_per_shape_is_each_shape_s_field(decoder, points):
    codes, batch = a_code(decoder, 4), points.reshape(4, 10, 3)
    each = [decoder.field(code)(points) for code, points in zip(codes, batch)]
    torch.testing.assert_close(decoder(batch, codes[:, None]), torch.stack(each))


@pytest.mark.parametrize("batch", [(), (0,), (1,), (5, 4, 2)])
def test_values_have_the_points_batch_axes(batch, points):
    decoder = randomised(PLAIN)
    field = decoder.field(a_code(decoder))
    given = points[: int(np.prod(batch))].reshape(*batch, 3)
    assert field(given).shape == batch
    torch.testing.assert_close(field(given).flatten(), field(given.reshape(-1, 3)))


def test_chunks_change_nothing(decoder, points):
    code = a_code(decoder)
    whole = decoder(points, code)
    for size in (1, 7, 39, 40, 1000):
        torch.testing.assert_close(chunked(decoder.field(code), size)(points.reshape(4, 10, 3)).flatten(), whole)


def test_more_points_than_a_chunk_are_as_good_as_few(monkeypatch, points):
    decoder = randomised(PLAIN)
    code = a_code(decoder)
    whole = decoder.field(code)(points)
    monkeypatch.setattr("distrace.fields.decoder.CHUNK", 7)
    monkeypatch.setattr("distrace.fields.decoder.RECORDED_CHUNK", 7)
    torch.testing.assert_close(decoder.field(code)(points), whole)
    with torch.no_grad():
        torch.testing.assert_close(decoder.field(code)(points), whole)


def test_gradients_agree_with_finite_differences_in_code_and_points(decoder, points):
    code = a_code(decoder).requires_grad_()
    points = points[:5].requires_grad_()
    assert torch.autograd.gradcheck(lambda code, points: decoder.field(code)(points), (code, points))
    assert torch.autograd.gradcheck(decoder, (points, code))


def test_gradients_agree_with_finite_differences_in_the_weights(decoder, points):
    code, used = a_code(decoder), {}
    for name, parameter in decoder.named_parameters():
        if name != f"bn{decoder.depth - 1}.weight" and name != f"bn{decoder.depth - 1}.bias":
            used[name] = parameter

    def values(*weights):
        return functional_call(decoder, dict(zip(used, weights)), (points[:3], code))

    assert torch.autograd.gradcheck(values, tuple(used.values()), fast_mode=True)


def test_gradients_reach_the_weights_through_a_field(points):
    decoder = randomised(PLAIN)
    code = a_code(decoder)
    through_field = torch.autograd.grad(decoder.field(code)(points).sum(), list(decoder.parameters()))
    through_forward = torch.autograd.grad(decoder(points, code).sum(), list(decoder.parameters()))
    torch.testing.assert_close(through_field, through_forward)


def test_dropout_acts_in_training_alone(points):
    decoder = randomised(NetworkSpecs(dims=(64,) * 2, code_length=3, latent_in=(), dropout=(0, 1), dropout_prob=0.5))
    code = a_code(decoder)
    torch.testing.assert_close(decoder(points, code), decoder(points, code), rtol=0, atol=0)
    decoder.train()
    assert not torch.equal(decoder(points, code), decoder(points, code))


def units(field: ShapeField) -> list[int]:
    return [len(bias) for _, bias in field.layers]


def a_place(points: torch.Tensor) -> torch.Tensor:
    """All points within a small cube."""
    return 0.05 * points + torch.tensor([0.4, -0.3, 0.2], dtype=torch.float64)


def test_a_pruned_field_has_the_same_values_at_its_points(decoder, points):
    field, here = decoder.field(a_code(decoder)), a_place(points)
    values, pruned_field = field.pruned(here)
    torch.testing.assert_close(values, field(here).detach(), rtol=0, atol=0)
    torch.testing.assert_close(pruned_field(here), values, rtol=0, atol=1e-12)


def test_a_pruned_field_has_never_more_units(decoder, points):
    field = decoder.field(a_code(decoder))
    _, pruned_field = field.pruned(points)
    assert all(few <= many for few, many in zip(units(pruned_field), units(field), strict=True))
    assert units(pruned_field)[-1] == 1


def wide() -> tuple[Decoder, ShapeField]:
    decoder = randomised(NetworkSpecs(dims=(96,) * 4, code_length=5, latent_in=(2,), norm_layers=(0, 1, 2, 3)))
    return decoder, decoder.field(a_code(decoder))


def test_around_a_small_place_many_units_are_off(points):
    _, field = wide()
    _, pruned_field = field.pruned(a_place(points))
    assert sum(units(pruned_field)) < 0.75 * sum(units(field))
    assert all(width % 16 == 0 for width in units(pruned_field)[:-1])


@pytest.mark.parametrize("size", [0.1, 0.3, 0.6, 1.0])
def test_no_unit_is_lost_that_is_on_at_any_of_the_points(size, points):
    _, field = wide()
    values, pruned_field = field.pruned(size * points)
    assert sum(units(pruned_field)) < sum(units(field))
    torch.testing.assert_close(pruned_field(size * points), values, rtol=0, atol=1e-12)


def test_near_its_points_a_pruned_field_is_the_same_up_to_units_just_switched_on(points):
    _, field = wide()
    _, pruned_field = field.pruned(a_place(points))
    beside = a_place(points.flip(-1))
    torch.testing.assert_close(pruned_field(beside), field(beside), rtol=0, atol=1e-3)
    assert (pruned_field(beside) - field(beside)).abs().mean() < 1e-5


def test_a_pruned_field_may_be_pruned_again(points):
    _, field = wide()
    _, pruned_field = field.pruned(points)
    values, pruned_again = pruned_field.pruned(a_place(points))
    assert sum(units(pruned_again)) < sum(units(pruned_field))
    torch.testing.assert_close(values, field(a_place(points)).detach(), rtol=0, atol=1e-12)
    torch.testing.assert_close(pruned_again(a_place(points)), values, rtol=0, atol=1e-12)


def test_points_of_many_chunks_are_pruned_together(monkeypatch, points):
    decoder, _ = wide()
    monkeypatch.setattr("distrace.fields.decoder.RECORDED_CHUNK", 7)
    field = decoder.field(a_code(decoder))
    values, pruned_field = field.pruned(a_place(points))
    torch.testing.assert_close(values, field(a_place(points)).detach(), rtol=0, atol=1e-12)
    torch.testing.assert_close(pruned_field(a_place(points)), values, rtol=0, atol=1e-12)


def test_layer_norms_need_all_units(points):
    decoder = randomised(ARCHITECTURES["layer norm"])
    field = decoder.field(a_code(decoder))
    values, same = field.pruned(points)
    assert same is field
    torch.testing.assert_close(values, field(points).detach())


def test_in_training_and_without_points_a_field_stays_as_it_is(points):
    decoder, field = wide()
    assert field.pruned(points[:0])[1] is field
    assert field.pruned(points[:0])[0].shape == (0,)
    decoder.train()
    assert field.pruned(points)[1] is field


def test_values_where_a_field_is_pruned_carry_no_gradient(points):
    _, field = wide()
    assert field(points).requires_grad
    assert not field.pruned(points)[0].requires_grad


def a_selection(count: int, shapes: int) -> torch.Tensor:
    return torch.randint(shapes, (count,), generator=torch.Generator().manual_seed(3))


def test_a_batch_is_the_field_of_each_of_its_shapes(decoder, points):
    codes, sets = a_code(decoder, 4), points.reshape(4, 5, 2, 3)
    field = decoder.field(codes)
    assert len(field) == 4
    assert torch.equal(field.codes, codes)
    each = torch.stack([decoder.field(code)(some) for code, some in zip(codes, sets)])
    torch.testing.assert_close(field(sets), each)
    with torch.no_grad():
        torch.testing.assert_close(field(sets), each)
    for single, code, some in zip(field, codes, sets):
        assert isinstance(single, ShapeField)
        assert torch.equal(single.code, code)
        assert torch.equal(single(some), decoder.field(code)(some))
    assert torch.equal(field[2](points), decoder.field(codes[2])(points))


@pytest.mark.parametrize("batch", [(), (2,), (0,), (2, 1)])
def test_a_selection_takes_each_point_for_its_own_shape(decoder, points, batch):
    codes, shape = a_code(decoder, 3), a_selection(20, 3)
    field = decoder.field(codes).select(shape)
    given = points[:20].expand(*batch, 20, 3)
    each = torch.stack([decoder.field(codes[b])(point) for b, point in zip(shape, points)]).expand(*batch, 20)
    torch.testing.assert_close(field(given), each)
    with torch.no_grad():
        torch.testing.assert_close(field(given), each)


def test_gradients_of_a_selection_agree_with_finite_differences(decoder, points):
    codes, shape = a_code(decoder, 3).requires_grad_(), a_selection(5, 3)
    points = points[:5].requires_grad_()

    def values(codes, points):
        return decoder.field(codes).select(shape)(points)

    assert torch.autograd.gradcheck(values, (codes, points))
    assert torch.autograd.gradgradcheck(values, (codes, points), atol=1e-4)


def test_gradients_reach_the_weights_through_a_selection(points):
    decoder = randomised(PLAIN)
    codes, shape = a_code(decoder, 3), a_selection(len(points), 3)
    through_selection = torch.autograd.grad(
        decoder.field(codes).select(shape)(points).sum(), list(decoder.parameters())
    )
    through_forward = torch.autograd.grad(decoder(points, codes[shape]).sum(), list(decoder.parameters()))
    torch.testing.assert_close(through_selection, through_forward)


@pytest.mark.parametrize("recorded", [False, True])
def test_chunks_of_a_selection_change_nothing(monkeypatch, points, recorded):
    decoder = randomised(PLAIN)
    field = decoder.field(a_code(decoder, 3)).select(a_selection(len(points), 3))
    with torch.set_grad_enabled(recorded):
        whole = field(points)
        monkeypatch.setattr("distrace.fields.decoder.CHUNK", 7)
        monkeypatch.setattr("distrace.fields.decoder.RECORDED_CHUNK", 7)
        torch.testing.assert_close(field(points), whole)


def test_points_for_another_number_of_shapes_are_refused(points):
    field = randomised(PLAIN).field(torch.zeros(3, 5))
    with pytest.raises(
        ValueError, match=r"^points of shape \[40, 3\] were given to a field of 3 shapes; give \[3, '...', 3\]$"
    ):
        field(points)
    with pytest.raises(ValueError, match=r"^points of shape \[40, 3\] were given, but 2 shapes selected; give"):
        field.select(torch.tensor([0, 1]))(points)
    with pytest.raises(ValueError, match=r"^shapes -1 to 3 were selected; there are 3, counted from 0$"):
        field.select(torch.tensor([0, 3, -1]))
    with pytest.raises(ValueError, match=r"^points in torch.float32 were given to a decoder in torch.float64"):
        field.select(torch.tensor([0, 1]))(points[:2].float())


@pytest.mark.parametrize(("select", "most"), [(False, 24), (True, 28)])
def test_without_derivatives_65_536_points_take_about_two_operations_a_layer(select, most):
    decoder, points = randomised(ARCHITECTURES["as published"]), torch.zeros(1 << 16, 3, dtype=torch.float64)
    field = decoder.field(a_code(decoder))
    if select:
        field = decoder.field(a_code(decoder, 3)).select(a_selection(len(points), 3))
    with torch.no_grad(), Operations() as operations:
        field(points)
    assert operations.count <= most


def test_without_derivatives_values_are_the_same(decoder, points):
    field = decoder.field(a_code(decoder))
    with torch.no_grad():
        values = field(points)
    assert not values.requires_grad
    torch.testing.assert_close(values, field(points).detach())


@pytest.mark.parametrize("count", [40, 39, 3])
def test_values_stay_as_they_are_when_the_field_is_evaluated_again(decoder, points, count):
    field = decoder.field(a_code(decoder))
    with torch.no_grad():
        first = field(points)
        kept = first.clone()
        field(points[:count] + 1.0)
        assert torch.equal(first, kept)
        assert torch.equal(field(points), kept)


def test_threads_do_not_write_into_each_other_s_buffers(points):
    decoder = randomised(ARCHITECTURES["as published"])
    fields = [decoder.field(code) for code in a_code(decoder, 4)]
    many = points.repeat(100, 1)
    with torch.no_grad():
        expected = [field(many) for field in fields]

    def repeated(number: int) -> bool:
        with torch.no_grad():
            return all(torch.equal(fields[number](many), expected[number]) for _ in range(30))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(repeated, range(4)))


def test_modes_and_precisions_may_change_from_call_to_call(points):
    decoder = randomised(PLAIN)
    field, code = decoder.field(a_code(decoder)), a_code(decoder)
    expected = field(points).detach()
    with torch.inference_mode():
        torch.testing.assert_close(decoder.field(code)(points.repeat(50, 1))[:40], expected)
    with torch.no_grad():
        torch.testing.assert_close(field(points), expected)
        torch.testing.assert_close(torch.func.vmap(field)(points[:, None])[:, 0], expected)
        torch.testing.assert_close(decoder.float().field(code)(points.float()).double(), expected, atol=1e-5, rtol=1e-5)


def test_an_optimiser_s_step_is_seen_by_a_field_without_derivatives(points):
    decoder = randomised(ARCHITECTURES["no norm"])
    code = a_code(decoder)
    field = decoder.field(code)
    with torch.no_grad():
        decoder.lin2.weight.mul_(2.0)
        torch.testing.assert_close(field(points), decoder.field(code)(points))


def test_a_code_of_another_length_is_named():
    with pytest.raises(
        ValueError,
        match=r"^a code of shape \[4\] was given; this decoder takes \[5\]$",
    ):
        Decoder(PLAIN).field(torch.zeros(4))
    with pytest.raises(ValueError, match=r"^a code of shape \[2, 4\] was given; this decoder takes \[shapes, 5\]$"):
        Decoder(PLAIN).field(torch.zeros(2, 4))


@pytest.mark.parametrize(
    ("specs", "complaint"),
    [
        (NetworkSpecs(dims=(16, -5), code_length=4, latent_in=()), r"a code of 4 and layers of \[16, -5, 1\] outputs"),
        (NetworkSpecs(dims=(8, 16), code_length=8, latent_in=(1,)), r"layers of \[-3, 16, 1\] outputs"),
        (NetworkSpecs(dims=(3, 3), code_length=4, latent_in=(), xyz_in_all=True), r"layers of \[0, 0, 1\] outputs"),
        (NetworkSpecs(dims=(16,), code_length=0, latent_in=()), "a code of 0 and"),
    ],
)
def test_a_network_without_room_is_refused(specs, complaint):
    with pytest.raises(ValueError, match=complaint + ".* each must be at least 1$"):
        Decoder(specs)


@pytest.mark.parametrize("layer", [0, 1], ids=["fed first", "fed again"])
def test_points_keep_their_precision_under_autocast(layer: int) -> None:
    """In bfloat16 0.8004 is 0.8008: thinner parts could not be learnt."""
    decoder = Decoder(NetworkSpecs((5,), code_length=1, latent_in=(1,), norm_layers=()))
    steep = getattr(decoder, f"lin{layer}")
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter.zero_()
        steep.weight[0, -3], steep.bias[0] = 1000.0, -800.0
        decoder.lin1.weight[0, 0] = 1.0
        with torch.autocast("cpu", torch.bfloat16):
            value = decoder(torch.tensor([[0.8004, 0.0, 0.0]]), torch.zeros(1, 1))
    assert value.item() == pytest.approx(math.tanh(0.4), abs=0.005)
