"""The check of gradients: it agrees with what is right, and says so of what is wrong."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from distrace.camera import Camera
from distrace.checking.differences import differences, image_derivatives
from distrace.checking.gradcheck import ROUGHLY, STRAY, GradientCheck, check_gradients, compare
from distrace.checking.moves import all_moves, decoder_changes, in_double, own_changes
from distrace.checking.retrace import DOUBLE, SINGLE, STEP_OF_VIEW, Footprints, Retraced, minimum_near, root_near
from distrace.checkpoints.model import load_model
from distrace.fields import primitives
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.render import WIDEST

CAMERA = Camera.orbit(30, 20, 4.97, height=16, width=16)
VIEW = Camera.orbit(30, 20, 4.97, height=48, width=48, dtype=torch.float64)
FOOTPRINT = "footprint normal"
QUANTITIES = {"distance", "depth", "hit points", "normal", "clearance", FOOTPRINT}
PARAMETERS = {"camera rotation", "camera translation", "focal length", "principal point", "placement"}


def disagreeing(found: GradientCheck) -> set[tuple[str, str]]:
    return {(row.quantity, row.parameter) for row in found.rows if row.verdict == "disagrees"}


class Scaled(torch.autograd.Function):
    """The identity, with a backward pass that is wrong by a factor."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx, slope: Tensor) -> Tensor:
        return 1.1 * slope


def test_every_quantity_is_compared_by_every_parameter() -> None:
    found = check_gradients(primitives.sphere(0.5), CAMERA, parameters={"radius": lambda h: primitives.sphere(0.5 + h)})
    assert {(row.quantity, row.parameter) for row in found.rows} == {
        (quantity, parameter) for quantity in QUANTITIES for parameter in PARAMETERS | {"radius"}
    }
    assert found.agrees
    assert found.precision == DOUBLE
    assert found.evaluations > 1000
    assert max(row.worst for row in found.rows if row.quantity != FOOTPRINT) < 1e-5
    assert max(row.median for row in found.rows if row.quantity == FOOTPRINT) < 1e-3
    assert all(row.pixels > 20 and 0 <= row.x < 16 and 0 <= row.y < 16 for row in found.rows)
    by_radius = {row.quantity: row for row in found.rows if row.parameter == "radius"}
    assert by_radius["clearance"].derivative == (pytest.approx(-1),)
    assert by_radius["distance"].derivative[0] < -1


@pytest.mark.parametrize(
    ("radius", "wrong"),
    [
        (lambda h: 0.5 + Scaled.apply(h), QUANTITIES - {FOOTPRINT}),  # which may be off by a tenth
        (lambda h: 0.5 + h.detach(), QUANTITIES),
        (lambda h: (0.5 + h).clamp_max(0.5), QUANTITIES),
    ],
    ids=["scaled", "detached", "clamped"],
)
def test_a_lie_about_a_parameter_is_found_and_the_rest_agrees(
    radius: Callable[[Tensor], Tensor], wrong: set[str]
) -> None:
    found = check_gradients(
        primitives.sphere(0.5), CAMERA, parameters={"radius": lambda h: primitives.sphere(radius(h))}
    )
    assert disagreeing(found) == {(quantity, "radius") for quantity in wrong}


def test_a_lie_about_one_part_of_space_is_found_at_its_pixels() -> None:
    """The gradient by the radius is lost on the left half of the image."""

    def sphere(radius: Tensor) -> primitives.SDF:
        right = torch.tensor([1.0, 0, -0.577], dtype=torch.float64)  # of the camera's plane through the middle
        return lambda points: points.norm(dim=-1) - torch.where((points @ right) > 0, radius, radius.detach())

    found = check_gradients(primitives.sphere(0.5), CAMERA, parameters={"radius": lambda h: sphere(0.5 + h)})
    depth = next(row for row in found.rows if (row.quantity, row.parameter) == ("depth", "radius"))
    assert not depth.agrees
    assert depth.x < 8
    assert depth.derivative == (0,)
    assert depth.difference[0] < -1


@pytest.mark.parametrize(("width", "agrees"), [(0.08, True), (0.3, False)])
def test_a_hundredth_of_the_pixels_may_be_off(width: float, agrees: bool) -> None:
    """The gradient is lost in a small ball about the point of the sphere next to the camera."""
    middle = 0.5 * CAMERA.T_world_camera[:3, 3].double() / 4.97

    def sphere(radius: Tensor) -> primitives.SDF:
        lost = lambda points: (points - middle).norm(dim=-1) < width / 2  # noqa: E731
        return lambda points: points.norm(dim=-1) - torch.where(lost(points), radius.detach(), radius)

    camera = Camera.orbit(30, 20, 4.97, height=47, width=47)
    found = check_gradients(primitives.sphere(0.5), camera, parameters={"radius": lambda h: sphere(0.5 + h)})
    depth = next(row for row in found.rows if (row.quantity, row.parameter) == ("depth", "radius"))
    assert depth.agrees == agrees
    assert depth.worst == pytest.approx(1, abs=1e-3)
    assert depth.off > 0
    assert (depth.off <= STRAY * depth.pixels) == agrees


def test_not_one_derivative_may_be_no_number() -> None:
    middle = 0.5 * CAMERA.T_world_camera[:3, 3].double() / 4.97

    def sphere(h: Tensor) -> primitives.SDF:
        def sdf(points: Tensor) -> Tensor:
            value = points.norm(dim=-1) - 0.5 - h
            lost = (points - middle).norm(dim=-1) < 0.04
            return value + torch.zeros_like(value).index_put((lost,), (h * 0).sqrt())

        return sdf

    camera = Camera.orbit(30, 20, 4.97, height=47, width=47)
    found = check_gradients(primitives.sphere(0.5), camera, parameters={"radius": sphere})
    depth = next(row for row in found.rows if (row.quantity, row.parameter) == ("depth", "radius"))
    assert (depth.off, depth.worst) == (1, torch.inf)
    assert not depth.agrees


def test_a_wrong_gradient_in_space_is_found_by_what_depends_on_it() -> None:
    """Wrong by a direction; a mere factor cancels in −df / (∇f · v)."""

    def sheared(points: Tensor) -> Tensor:
        return primitives.sphere(0.5)(torch.cat([Scaled.apply(points[..., :1]), points[..., 1:]], dim=-1))

    wrong = disagreeing(check_gradients(sheared, CAMERA))
    assert {("distance", "camera translation"), ("depth", "placement"), ("clearance", "camera rotation")} <= wrong


def test_a_derivative_that_is_no_number_disagrees() -> None:
    found = check_gradients(
        primitives.sphere(0.5), CAMERA, parameters={"radius": lambda h: primitives.sphere(0.5 + h + (h * 0).sqrt())}
    )
    assert disagreeing(found) == {(quantity, "radius") for quantity in QUANTITIES - {"normal"}} | {("normal", "radius")}
    assert all(row.worst == torch.inf for row in found.rows if row.parameter == "radius")


def test_pixels_on_a_kink_are_left_out_and_counted() -> None:
    """As the box turns, faces meet on pixels; as h passes 0, its size grows only one way."""
    half = torch.tensor([0.5, 0.3, 0.4], dtype=torch.float64)
    found = check_gradients(
        primitives.box(half), CAMERA, parameters={"size": lambda h: primitives.box(half + h.clamp_min(0))}
    )
    for row in found.rows:
        if row.parameter == "size" and row.quantity not in ("normal", FOOTPRINT):
            assert row.pixels == 0 or row.quantity == "clearance", row
            assert row.left_out > 10


def test_a_row_of_which_no_pixel_could_be_compared_does_not_agree() -> None:
    found = check_gradients(
        primitives.sphere(0.5), CAMERA, parameters={"kink": lambda h: primitives.sphere(0.5 + h.abs())}
    )
    assert disagreeing(found) == {(quantity, "kink") for quantity in QUANTITIES - {FOOTPRINT}}
    row = next(row for row in found.rows if (row.quantity, row.parameter) == (FOOTPRINT, "kink"))
    assert row.verdict == "zero", "its steps leave no kink out, and both sides are equal"


class Ball(nn.Module):
    """A smooth network that is about a sphere."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layers = nn.Sequential(nn.Linear(3, 16), nn.Softplus(10), nn.Linear(16, 1))

    def forward(self, points: Tensor) -> Tensor:
        return points.norm(dim=-1) - 0.5 + 0.1 * self.layers(points)[..., 0]


def test_of_a_network_the_weights_are_checked_in_double_and_it_stays_as_it_was() -> None:
    network = Ball()
    found = check_gradients(network, CAMERA)
    assert found.agrees
    assert {row.parameter for row in found.rows} == PARAMETERS | {"weights"}
    assert found.precision == DOUBLE
    assert all(weight.dtype == torch.float32 for weight in network.parameters())


def test_a_field_that_knows_float32_alone_is_checked_in_that() -> None:
    network = Ball().requires_grad_(False)
    found = check_gradients(lambda points: network(points), CAMERA)
    assert found.precision == SINGLE
    assert found.agrees, disagreeing(found)
    lying = {"offset": lambda h: lambda points: network(points) + Scaled.apply(h)}
    found = check_gradients(lambda points: network(points), CAMERA, parameters=lying)
    assert disagreeing(found) >= {("depth", "offset"), ("clearance", "offset")}


def small_decoder() -> Decoder:
    torch.manual_seed(1)
    decoder = Decoder(NetworkSpecs(dims=(32,) * 3, code_length=4, latent_in=(2,), norm_layers=(0, 1, 2))).eval()
    with torch.no_grad():
        decoder.lin3.bias.fill_(-0.1)
        decoder.lin3.weight.abs_()
    return decoder


def test_of_a_decoder_code_and_weights_are_checked() -> None:
    double, code = small_decoder().double(), 0.1 * torch.ones(4, dtype=torch.float64)
    found = check_gradients(double.field(code), CAMERA, parameters=decoder_changes(double, code))
    rows = {(row.quantity, row.parameter): row for row in found.rows}
    for parameter in ("code", "weights"):
        for quantity in ("distance", "depth", "hit points"):
            assert rows[quantity, parameter].agrees, rows[quantity, parameter]
            assert rows[quantity, parameter].pixels > 10


def test_zero_against_zero_is_no_agreement() -> None:
    """The exact normal of a ReLU network is constant in each piece; the footprint's is not."""
    double, code = small_decoder().double(), 0.1 * torch.ones(4, dtype=torch.float64)
    found = check_gradients(double.field(code), CAMERA, parameters={})
    rows = {(row.quantity, row.parameter): row for row in found.rows}
    for parameter in ("camera rotation", "camera translation", "focal length", "principal point"):
        assert rows["normal", parameter].verdict == "zero"
        assert not rows["normal", parameter].agrees
        assert rows[FOOTPRINT, parameter].verdict != "zero"
        assert rows[FOOTPRINT, parameter].step == pytest.approx(WIDEST * STEP_OF_VIEW)
    assert rows["normal", "placement"].verdict == "agrees", "normals turn with the object"
    counts = found.verdicts()
    assert counts["zero"] == sum(row.verdict == "zero" for row in found.rows) == 4
    assert sum(counts.values()) == len(found.rows)
    assert found.agrees == (counts["disagrees"] == 0)


def test_a_footprint_normal_that_forgets_a_parameter_is_found() -> None:
    """Zero against differences that are not is a disagreement."""
    found = check_gradients(
        primitives.box(torch.tensor([0.5, 0.3, 0.4], dtype=torch.float64)),
        CAMERA,
        parameters={"bump": lambda h: lambda p: primitives.sphere(0.5)(p) + h.detach() * (20 * p[..., 0]).sin()},
    )
    row = next(row for row in found.rows if (row.quantity, row.parameter) == (FOOTPRINT, "bump"))
    assert row.verdict == "disagrees"


@pytest.mark.slow
def test_a_decoder_s_field_knows_its_code_and_the_decoder_stays_as_it_was() -> None:
    decoder = small_decoder()
    own = check_gradients(decoder.field(0.1 * torch.ones(4)), CAMERA, size=6)
    assert own.precision == DOUBLE
    assert {row.parameter for row in own.rows} == PARAMETERS | {"code", "weights"}
    double = small_decoder().double()
    code = (0.1 * torch.ones(4)).double()
    assert (
        own.rows == check_gradients(double.field(code), CAMERA, parameters=decoder_changes(double, code), size=6).rows
    )
    assert all(weight.dtype == torch.float32 and weight.requires_grad for weight in decoder.parameters())


@pytest.mark.slow
@pytest.mark.parametrize(("name", "code"), [("sofas", 3), ("chairs", 200), ("tables", 30), ("planes", 9)])
def test_the_footprint_normals_of_bundled_decoders_follow_differences_to_a_tenth(name: str, code: int) -> None:
    """Over steps that move hits: single pieces of the network do not matter there."""
    model = load_model(name)
    field = in_double(model.field(code))
    view = Retraced.of(field, VIEW, 1.0, DOUBLE)
    footprints = Footprints.of(view, field, VIEW)
    moves = all_moves(field, VIEW, {"code": own_changes(field)["code"]})
    tried = {"camera rotation": "y", "camera translation": "x", "focal length": "", "principal point": "y", "code": ""}
    errors = []
    for parameter, along in tried.items():
        found = footprints.slopes(moves[parameter][along], footprints.step(parameter == "code"))
        compared = compare(along, *found, None, DOUBLE)
        assert (~compared.error.isnan()).sum() > 20
        assert compared.difference.norm(dim=-1).nanmedian() > 1e-3
        assert compared.error.nanmedian() <= ROUGHLY, parameter
        errors.append(compared.error)
    assert torch.cat(errors).nanmedian() <= 0.1


def test_what_cannot_be_checked_is_refused() -> None:
    with pytest.raises(ValueError, match="sees nothing"):
        check_gradients(lambda points: points.norm(dim=-1) + 1, CAMERA)
    with pytest.raises(ValueError, match="an image of 0 pixels"):
        check_gradients(primitives.sphere(0.5), CAMERA, size=0)


def test_derivatives_are_those_of_every_element_and_zero_where_there_is_no_way() -> None:
    like, x = torch.zeros((), dtype=torch.float64), torch.arange(4, dtype=torch.float64)
    images = lambda h: {"sine": torch.sin(x + h), "none": x, "product": x * (3 * h)}  # noqa: E731
    found = image_derivatives(images, like)
    central, bend = differences(images, images(like), 1e-5, like)
    for name, expected in {"sine": x.cos(), "none": 0 * x, "product": 3 * x}.items():
        torch.testing.assert_close(found[name], expected)
        torch.testing.assert_close(central[name], expected, rtol=0, atol=1e-9)
        assert bend[name].abs().max() < 1e-4
    assert image_derivatives(lambda h: {"none": x}, like)["none"].eq(0).all()


def test_the_root_near_a_hit_is_found_or_none_is_claimed() -> None:
    rays = CAMERA.rays()[8:9, 8:9].flat()
    rays = type(rays)(rays.origins.double(), rays.directions.double())
    rays = type(rays)(rays.origins, rays.directions / rays.directions.norm(dim=-1, keepdim=True))
    middle = -(rays.origins * rays.directions).sum(-1)
    away = (rays.origins.square().sum(-1) - middle**2).sqrt()
    exact = middle - (0.25 - away**2).sqrt()
    slope = (rays.at(exact) * rays.directions).sum(-1) / 0.5
    torch.testing.assert_close(root_near(primitives.sphere(0.5), rays, exact + 1e-6, slope, 1e-11), exact)
    assert root_near(lambda p: p.norm(dim=-1) + 1, rays, exact, slope, 1e-11).isnan().all()
    torch.testing.assert_close(minimum_near(primitives.sphere(away - 0.1), rays, middle + 1e-5, 5e-5), away * 0 + 0.1)


def test_the_least_value_at_a_corner_is_between_all_samples() -> None:
    """|x| + 1 along the ray: no sample meets the corner, but two lines do."""
    rays = CAMERA.rays()[0, :1]
    rays = type(rays)(torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[1.0, 0, 0]], dtype=torch.float64))
    corner = lambda p: 1 + torch.where(p[..., 0] > 0.5, p[..., 0] - 0.5, 0.3 * (0.5 - p[..., 0]))  # noqa: E731
    found = minimum_near(corner, rays, torch.tensor([0.50003], dtype=torch.float64), 5e-5)
    assert found.item() == pytest.approx(1, abs=1e-14)
