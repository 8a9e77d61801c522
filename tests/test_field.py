"""Fields and the wrappers that turn one into another."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from distrace.camera import Camera
from distrace.fields import primitives
from distrace.fields.base import Counted, chunked, placed, pruned, value_and_gradient
from distrace.mesh import MeshConfig, extract_mesh
from distrace.render import render
from distrace.tracing.sphere_tracing import TraceConfig

WRONG = {
    "column": lambda p: p[..., :1],
    "scalar": lambda p: p.sum(),
    "number": lambda p: 0.5,
    "double": lambda p: p[..., 0].double(),
    "sign": lambda p: p[..., 0] > 0,
}
f64 = torch.float64
fine = TraceConfig(steps=300, step_scale=1.0, tolerance=1e-9, coarse_levels=0)


def points(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=f64)


def similarity(seed: int, scale: float = 1.0, shift: float = 1.0) -> torch.Tensor:
    skew = points(seed, 3)
    matrix = torch.eye(4, dtype=f64)
    matrix[:3, :3] = scale * torch.linalg.matrix_exp(skew - skew.T)
    matrix[:3, 3] = shift * points(seed + 1)
    return matrix


@given(shape=st.lists(st.integers(1, 5), max_size=3), size=st.integers(1, 40), seed=st.integers(0, 1000))
def test_a_field_in_chunks_is_the_field_and_no_chunk_is_larger(shape: list[int], size: int, seed: int) -> None:
    sizes = []
    whole = primitives.torus(0.5, 0.2)

    def watched(p: torch.Tensor) -> torch.Tensor:
        sizes.append(p.shape[:-1].numel())
        return whole(p)

    p = points(seed, *shape)
    values = chunked(watched, size)(p)
    assert values.shape == p.shape[:-1]
    torch.testing.assert_close(values, whole(p), rtol=1e-12, atol=1e-12)
    assert max(sizes) <= size
    assert sum(sizes) == p.shape[:-1].numel()


def test_a_counted_field_counts_points_not_calls() -> None:
    counted = Counted(primitives.sphere(0.5))
    p = points(0, 2, 5)
    torch.testing.assert_close(counted(p), p.norm(dim=-1) - 0.5)
    counted(p[0, 0])
    assert counted.evaluations == 11


class Halved:
    """A field that is another one where it is pruned: half as large."""

    def __call__(self, points: torch.Tensor) -> torch.Tensor:
        return points.norm(dim=-1)

    def pruned(self, points: torch.Tensor) -> tuple[torch.Tensor, primitives.SDF]:
        return self(points), lambda others: self(others) / 2


def test_a_plain_function_is_pruned_to_itself() -> None:
    sphere, p = primitives.sphere(0.5), points(0, 5)
    values, same = pruned(sphere, p)
    assert same is sphere
    torch.testing.assert_close(values, sphere(p))


def test_a_field_that_can_be_pruned_is() -> None:
    p = points(0, 5)
    values, half = pruned(Halved(), p)
    torch.testing.assert_close(values, p.norm(dim=-1))
    torch.testing.assert_close(half(p), p.norm(dim=-1) / 2)


@pytest.mark.parametrize(("field", "factor"), [(primitives.sphere(0.0), 1.0), (Halved(), 0.5)], ids=["plain", "halved"])
def test_a_counted_field_counts_what_it_is_pruned_at_and_what_comes_of_that(
    field: primitives.SDF, factor: float
) -> None:
    counted, p = Counted(field), points(0, 7)
    values, near = pruned(counted, p)
    assert counted.evaluations == 7
    torch.testing.assert_close(values, p.norm(dim=-1))
    torch.testing.assert_close(near(points(1, 2, 4)), factor * points(1, 2, 4).norm(dim=-1))
    assert counted.evaluations == 15
    counted(p)
    assert counted.evaluations == 22


def test_gradients_go_through_the_chunks() -> None:
    p = points(3, 10).requires_grad_()
    chunked(primitives.sphere(0.5), 3)(p).sum().backward()
    torch.testing.assert_close(p.grad, p.detach() / p.detach().norm(dim=-1, keepdim=True))


@given(seed=st.integers(0, 1000), scale=st.floats(0.2, 5), radius=st.floats(0.1, 1))
def test_a_placed_sphere_is_a_sphere_of_scaled_radius_at_the_translation(
    seed: int, scale: float, radius: float
) -> None:
    T_world_object = similarity(seed, scale)
    centre = T_world_object[:3, 3]
    p = points(seed + 7, 50)
    torch.testing.assert_close(
        placed(primitives.sphere(radius), T_world_object)(p), (p - centre).norm(dim=-1) - scale * radius
    )


@given(seed=st.integers(0, 1000), scale=st.floats(0.2, 5))
def test_a_placed_field_has_at_moved_points_the_scaled_values(seed: int, scale: float) -> None:
    T_world_object = similarity(seed, scale)
    box = primitives.box(torch.tensor([0.3, 0.5, 0.2], dtype=f64))
    p = points(seed + 7, 50)
    moved = p @ T_world_object[:3, :3].T + T_world_object[:3, 3]
    torch.testing.assert_close(placed(box, T_world_object)(moved), scale * box(p))


@given(seed=st.integers(0, 100))
def test_moving_field_and_camera_together_leaves_the_buffers(seed: int) -> None:
    motion = similarity(seed, shift=0.3)
    box = primitives.box(torch.tensor([0.3, 0.5, 0.2], dtype=f64))
    camera = Camera.orbit(30, 20, 4.97, height=24, width=24, dtype=f64)
    moved = Camera.from_matrices(camera.intrinsics, motion @ camera.T_world_camera, 24, 24)
    here = render(box, camera, radius=3.0, config=fine)
    there = render(placed(box, motion), moved, radius=3.0, config=fine)
    assert here.mask.any()
    assert (here.mask == there.mask).all()
    torch.testing.assert_close(there.depth, here.depth, rtol=0, atol=1e-7)
    torch.testing.assert_close(there.normal, here.normal @ motion[:3, :3].T, rtol=0, atol=1e-7)


def test_a_placement_is_differentiable() -> None:
    T_world_object = similarity(5, 1.3)
    p = points(6, 4)
    assert torch.autograd.gradcheck(
        lambda top: placed(primitives.sphere(0.4), torch.cat([top, T_world_object[3:]]))(p),
        T_world_object[:3].clone().requires_grad_(),
    )


def test_value_and_gradient_of_a_sphere_are_distance_and_direction() -> None:
    p = points(1, 20)
    value, gradient = value_and_gradient(primitives.sphere(0.5), p)
    torch.testing.assert_close(value, p.norm(dim=-1) - 0.5)
    torch.testing.assert_close(gradient, p / p.norm(dim=-1, keepdim=True))
    assert not p.requires_grad


def test_the_gradient_is_differentiable_unless_it_is_asked_not_to_be() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)

    def stretched(p: torch.Tensor) -> torch.Tensor:
        return radius * p.norm(dim=-1)

    p = points(2, 20)
    _, gradient = value_and_gradient(stretched, p)
    (by_radius,) = torch.autograd.grad((gradient * p).sum(), radius)
    torch.testing.assert_close(by_radius, p.norm(dim=-1).sum())
    value, gradient = value_and_gradient(stretched, p, second_order=False)
    assert not gradient.requires_grad
    (by_radius,) = torch.autograd.grad(value.sum(), radius)
    torch.testing.assert_close(by_radius, p.norm(dim=-1).sum())


@pytest.mark.parametrize("requires_grad", [False, True])
def test_without_grad_mode_there_is_a_gradient_but_no_graph(requires_grad: bool) -> None:
    p = points(2, 20).requires_grad_(requires_grad)
    with torch.no_grad():
        value, gradient = value_and_gradient(primitives.sphere(0.5), p)
    assert not value.requires_grad
    assert not gradient.requires_grad
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(20, dtype=f64))


@pytest.mark.parametrize("name", WRONG)
def test_a_field_that_gives_something_else_than_distances_is_told(name: str) -> None:
    camera = Camera.orbit(30, 20, 3.0, height=4, width=4)
    for ask in (
        lambda: render(WRONG[name], camera),
        lambda: render(WRONG[name], camera, config=TraceConfig()),
        lambda: extract_mesh(WRONG[name], MeshConfig(16)),
    ):
        with pytest.raises(
            ValueError, match=r"the field gave .*; one distance for each is needed, torch.float32 of shape"
        ):
            ask()
