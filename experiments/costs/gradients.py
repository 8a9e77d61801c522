"""Exact derivatives of depth, and DIST's, against finite differences: on a sphere, a box and a decoder."""

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checking.differences import Images, differences, image_derivatives
from distrace.checking.gradcheck import Compared, compare
from distrace.checking.moves import Change, Move, counted_moves, decoder_changes
from distrace.checking.retrace import DOUBLE, Retraced
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF, Counted
from distrace.fields.primitives import box, sphere
from distrace.rays import meet_sphere
from distrace.render import Buffers
from experiments.costs.dist_gradient import attach_dist, march

QUERIES = (1, 3, 5)  # of DIST's gradient
RADIUS = 0.5  # of the sphere
HALF = (0.5, 0.3, 0.3)  # sizes of the box
COUNT = 9 * (1 + len(QUERIES))  # of rows
SHARE = 0.1  # of the median derivative: pixels with a smaller one have no ratio


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
class Subject:
    """A field, its camera, and the moves along which derivatives are taken: the first component of each parameter."""

    field: str
    sdf: Counted
    camera: Camera
    moves: dict[str, Move]


def subjects(model: Model, code: Float[Tensor, "length"], size: int) -> list[Subject]:
    """Returns a sphere, a box that shows a face at 6° from its plane, and a decoder; all in float64."""
    half = torch.tensor(HALF, dtype=torch.float64)
    decoder = deepcopy(model.decoder).double().cpu()
    latent = code.detach().double().cpu()
    lens = ("focal length",)
    return [  # the focal lengths let each shape fill its image
        _subject("sphere", sphere(RADIUS), _camera(30, 20, 130, size), {"radius": lambda h: sphere(RADIUS + h)}),
        _subject("box", box(half), _camera(81, 8, 130, size), {"size": lambda h: box(half + h)}, lens),
        _subject("decoder", decoder.field(latent), _camera(30, 20, 75, size), decoder_changes(decoder, latent), lens),
    ]


def _camera(azimuth: float, elevation: float, focal_mm: float, size: int) -> Camera:
    return Camera.orbit(azimuth, elevation, 4.97, focal_mm=focal_mm, height=size, width=size, dtype=torch.float64)


def _subject(name: str, sdf: SDF, camera: Camera, changes: dict[str, Change], moved: tuple[str, ...] = ()) -> Subject:
    """Returns a field with its own changes, translations of the camera, and the other moves of it in `moved`."""
    counted = Counted(sdf)
    moves = counted_moves(counted, camera, changes)
    parameters = (*changes, "camera translation", *moved)
    return Subject(name, counted, camera, {key: next(iter(moves[key].values())) for key in parameters})


def ratio_rows(subject: Subject) -> Iterator[tuple[RatioRow, Float[Tensor, "height width"]]]:
    """Yields each parameter by each method, with the image of the ratio; NaN where there is none."""
    view = Retraced.of(subject.sdf, subject.camera, 1.0, DOUBLE)
    hit = view.trace.hit
    rays = subject.camera.rays()
    marched = march(subject.sdf, rays, meet_sphere(rays), queries=max(QUERIES))
    values = view.retraced_hits(subject.sdf, subject.camera)
    like = values["depth"]

    def exact(sdf: SDF, camera: Camera) -> Images:
        return {"depth": Buffers(sdf, camera.rays(), camera.cosines(), view.trace, view.radius).depth[hit]}

    def dist(queries: int, sdf: SDF, camera: Camera) -> Images:
        return {"depth": camera.depth(attach_dist(sdf, camera.rays(), marched, queries))[hit]}

    methods = {"exact": exact} | {f"DIST, k = {k}": partial(dist, k) for k in QUERIES}
    for parameter, move in subject.moves.items():
        central, kinks = differences(lambda h, move=move: view.retraced_hits(*move(h)), values, DOUBLE.step, like)
        kink = kinks["depth"].masked_fill(marched.distance[hit].isinf(), torch.nan)
        for method, images in methods.items():
            slopes = image_derivatives(lambda h, move=move, images=images: images(*move(h)), like)
            compared = compare(parameter, slopes["depth"], central["depth"], kink, DOUBLE)
            ratio = _ratio(compared)
            row = _ratio_row((subject.field, parameter, method), compared.error, ratio[~ratio.isnan()])
            yield row, torch.full_like(view.trace.distance, torch.nan).masked_scatter(hit, ratio)


def _ratio(compared: Compared) -> Float[Tensor, "n"]:
    """Returns derivative by difference; NaN for a pixel that is left out, or has a small derivative."""
    difference = compared.difference[:, 0]
    large = difference.abs() > SHARE * difference.abs().nanmedian()
    ratio = compared.derivative[:, 0] / difference
    return ratio.masked_fill(compared.error.isnan() | ~large, torch.nan)


def _ratio_row(names: tuple[str, str, str], error: Float[Tensor, "n"], ratio: Float[Tensor, "m"]) -> RatioRow:
    left_out = error.isnan()
    low, middle, high = ratio.quantile(ratio.new_tensor([0.1, 0.5, 0.9])).tolist()
    return RatioRow(
        *names,
        relative_error=float(error.nanmedian()),
        worst=float(error[~left_out].max()),
        ratio=middle,
        ratio_low=low,
        ratio_high=high,
        pixels=int((~left_out).sum()),
        left_out=int(left_out.sum()),
    )
