"""Rows of `bench gradients`: exact derivatives and DIST's against differences, and the time of a backward pass."""

import time
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checking.differences import Images, derivatives, differences
from distrace.checking.dist_gradient import Queries, attach_dist, march
from distrace.checking.gradcheck import Compared, compare
from distrace.checking.moves import Change, Move, Tally, all_moves, decoder_changes
from distrace.checking.retrace import DOUBLE, Retraced
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF
from distrace.fields.primitives import box, sphere
from distrace.rays import meet_sphere
from distrace.render import Buffers, render

EXACT = "exact"
QUERIES = (1, 3, 5)  # of DIST's gradient
RADIUS = 0.5  # of the sphere
HALF = (0.5, 0.3, 0.3)  # sizes of the box
COUNT = 9 * (1 + len(QUERIES))  # of rows
SIZE = 64  # pixels along each side
SHARE = 0.1  # of the median derivative: pixels with a smaller one have no ratio

View = Callable[[SDF, Camera], Images]


@dataclass(frozen=True)
class RatioRow:
    """The ratio of the derivatives of depth by a parameter to finite differences, over the pixels of an image."""

    field: str
    parameter: str
    method: str
    relative_error: float  # the median
    worst: float
    ratio: float  # of derivative to difference, the median
    ratio_low: float  # its tenth percentile
    ratio_high: float  # its ninetieth
    pixels: int
    left_out: int  # kinks, and rays on which DIST's march ends without a hit


@dataclass(frozen=True)
class Timing:
    """The time of a depth image and of its gradient. Medians, of runs in turn."""

    parameter: str
    pixels: int
    visible: int
    forward: float  # seconds
    backward: float
    ratio: float
    runs: int


@dataclass(frozen=True)
class Subject:
    """A field, its camera, and the moves along which derivatives are taken."""

    field: str
    sdf: SDF
    camera: Camera
    moves: dict[str, Move]
    tally: Tally

    @staticmethod
    def of(field: str, sdf: SDF, camera: Camera, changes: dict[str, Change], parameters: tuple[str, ...]) -> "Subject":
        """Takes the first component of each parameter."""
        tally = Tally()
        moves = all_moves(sdf, camera, changes)
        counted = {name: tally.move(next(iter(moves[name].values()))) for name in parameters}
        return Subject(field, tally.field(sdf), camera, counted, tally)


def subjects(model: Model, code: int, size: int) -> list[Subject]:
    """Returns a sphere, a box that shows a face at 6° from its plane, and a decoder; all in float64."""
    like = torch.zeros(3, dtype=torch.float64)
    half = like.new_tensor(HALF)
    view_sphere, view_box, view_decoder = (
        Camera.orbit(*angles, 4.97, focal_mm=focal_mm, height=size, width=size, dtype=like.dtype)
        for angles, focal_mm in (((30, 20), 130), ((81, 8), 130), ((30, 20), 75))  # each shape fills its image
    )
    decoder = deepcopy(model.decoder).double().cpu()
    latent = model.codes[code].detach().double().cpu()
    camera_moves = ("camera translation", "focal length")
    return [
        Subject.of(
            "sphere",
            sphere(RADIUS),
            view_sphere,
            {"radius": lambda h: sphere(RADIUS + h)},
            ("radius", "camera translation"),
        ),
        Subject.of("box", box(half), view_box, {"size": lambda h: box(half + h)}, ("size", *camera_moves)),
        Subject.of(
            "decoder",
            decoder.field(latent),
            view_decoder,
            decoder_changes(decoder, latent),
            ("code", "weights", *camera_moves),
        ),
    ]


def ratio_rows(subject: Subject) -> Iterator[tuple[RatioRow, Float[Tensor, "height width"]]]:
    """Yields each parameter by each method, with the image of the ratio; NaN where there is none."""
    view = Retraced.of(subject.sdf, subject.camera, 1.0, DOUBLE)
    rays = subject.camera.rays()
    marched = march(subject.sdf, rays, meet_sphere(rays), queries=max(QUERIES))
    missed = marched.distance[view.trace.hit].isinf()
    values = view.retraced_hits(subject.sdf, subject.camera)
    for parameter, move in subject.moves.items():
        central, kinks = differences(partial(_moved, view.retraced_hits, move), values, DOUBLE.step, values["depth"])
        kink = kinks["depth"].masked_fill(missed, torch.nan)
        for method, render_depth in _methods(view, marched).items():
            slopes = derivatives(partial(_moved, render_depth, move), values["depth"])
            compared = compare(parameter, slopes["depth"], central["depth"], kink, DOUBLE)
            yield _ratio_row(view, (subject.field, parameter, method), compared)


def _moved(view: View, move: Move, h: Tensor) -> Images:
    return view(*move(h))


def _methods(view: Retraced, marched: Queries) -> dict[str, View]:
    """Returns each method's differentiable depth of the hits."""
    hit = view.trace.hit

    def exact(sdf: SDF, camera: Camera) -> Images:
        return {"depth": Buffers(sdf, camera.rays(), camera.cosines(), view.trace, view.radius).depth[hit]}

    def dist(queries: int, sdf: SDF, camera: Camera) -> Images:
        return {"depth": camera.depth(attach_dist(sdf, camera.rays(), marched, queries))[hit]}

    return {EXACT: exact} | {f"DIST, k = {k}": partial(dist, k) for k in QUERIES}


def _ratio_row(view: Retraced, names: tuple[str, str, str], compared: Compared) -> tuple[RatioRow, Tensor]:
    error = compared.error
    difference = compared.difference[:, 0]
    valid = ~error.isnan()
    large = valid & (difference.abs() > SHARE * difference.abs().nanmedian())
    ratio = (compared.derivative[:, 0] / difference).masked_fill(~large, torch.nan)
    low, middle, high = ratio[large].quantile(ratio.new_tensor([0.1, 0.5, 0.9])).tolist()
    row = RatioRow(
        *names,
        relative_error=float(error.nanmedian()),
        worst=float(error[valid].max()),
        ratio=middle,
        ratio_low=low,
        ratio_high=high,
        pixels=int(valid.sum()),
        left_out=int((~valid).sum()),
    )
    return row, torch.full_like(view.trace.distance, torch.nan).masked_scatter(view.trace.hit, ratio)


def timings(model: Model, code: int, camera: Camera, repeats: int) -> list[Timing]:
    """Times a depth image of the default tracer and its backward pass, by code and by camera, after a warm-up run."""
    parameters = {"code": _with_code, "camera": _with_camera}
    runs: dict[str, list[tuple[float, float, int]]] = {name: [] for name in parameters}
    for _ in range(repeats + 1):
        for name, differentiable in parameters.items():
            runs[name].append(_timed(*differentiable(model, code, camera)))
    return [_timing(name, camera, times[1:] or times) for name, times in runs.items()]


def _timing(name: str, camera: Camera, times: list[tuple[float, float, int]]) -> Timing:
    forward, backward, visible = zip(*times)
    before = median(forward)
    after = median(backward)
    return Timing(name, camera.height * camera.width, visible[0], before, after, after / before, len(times))


def _with_code(model: Model, code: int, camera: Camera) -> tuple[SDF, Camera]:
    return model.field(model.codes[code].detach().clone().requires_grad_()), camera


def _with_camera(model: Model, code: int, camera: Camera) -> tuple[SDF, Camera]:
    intrinsics = camera.intrinsics.detach().clone().requires_grad_()
    pose = camera.T_world_camera.detach().clone().requires_grad_()
    return model.field(code), Camera(intrinsics, pose, camera.height, camera.width)


def _timed(sdf: SDF, camera: Camera) -> tuple[float, float, int]:
    """Returns the seconds of tracing, the seconds from there to the gradient, and the number of visible pixels."""
    start = time.perf_counter()
    buffers = render(sdf, camera)
    visible = int(buffers.mask.sum())
    traced = time.perf_counter()
    buffers.depth[buffers.mask].sum().backward()
    if camera.intrinsics.is_cuda:
        torch.cuda.synchronize()
    return traced - start, time.perf_counter() - traced, visible
