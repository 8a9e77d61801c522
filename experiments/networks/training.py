"""Training of placement networks: random views of simulated scans, and the likelihood of the true placement."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import roma
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import log_softmax, normalize, softmax
from torch.nn.utils import clip_grad_norm_

from distrace.fitting.placement_network import TURN_BINS, GridFrame, PlacementNetwork, grids_of, likeliest_turns
from distrace.fitting.scan_starts import LIKELY
from distrace.rays import Rays
from experiments.networks.scans import TrainingScans

VALIDATION = 250  # scans
BATCH = 64
LEARNING_RATE = 2e-3
WEIGHT_DECAY = 2e-2
WARM_UP = 200  # steps
TURN_DEVIATION = 4.0  # degrees, of the true turn's probabilities
PLACE_WEIGHT = 0.3  # of the likelihood of centre, size and tilt, beside the turn's
TILT = 4.0  # degrees, by which up is wrong in half of the views
VIEWER = 10.0  # degrees, by which the direction of the viewer is
CLOUDS = 0.2  # of the views show points alone, from nobody knows where
CUT = 0.3  # of the views lack what lies beyond a plane
SPARSE = 0.5  # of the views lack points, up to 97 % of them
NOISE = 0.01  # radii of the scan, at most
RESIZED = 0.1  # standard deviation of the logarithm of the scan's radius
SHIFTED = 0.05  # radii, of its centre


@dataclass(frozen=True)
class Views:
    """Grids of scans in random frames, and the true placements in these frames."""

    grids: Float[Tensor, "b channels cells cells"]
    turn: Float[Tensor, "b"]  # radians
    place: Float[Tensor, "b 6"]  # centre, logarithm of the size, and the tilt's x and z


def views_of(scans: TrainingScans, random: torch.Generator, varied: bool) -> Views:
    """Returns a view of each scan; `varied` ones with the faults that real scans may have."""
    count = len(scans)
    points = scans.points
    known = torch.ones(points.shape[:2], dtype=torch.bool)
    up = scans.up
    centre = scans.centre
    radius = scans.radius
    ahead = centre - scans.eye
    until = scans.until
    if varied:
        tilted = (torch.rand(count, 1, generator=random) < 0.5) * math.radians(TILT)
        up = _turned(up, torch.randn(count, 3, generator=random) * tilted)
        noise = NOISE * radius * torch.rand(count, generator=random)
        points = points + torch.randn(points.shape, generator=random) * noise[:, None, None]
        known = _cut(points, centre, random) & _sparse(known, random)
        cloud = torch.rand(count, generator=random) < CLOUDS
        angle = 2 * math.pi * torch.rand(count, generator=random)
        anywhere = torch.stack([angle.cos(), torch.zeros(count), angle.sin()], dim=-1)
        ahead = torch.where(cloud[:, None], anywhere, ahead)
        until = torch.where(cloud[:, None], 0.0, until)
        about = math.radians(VIEWER) * torch.randn(count, 1, generator=random) * torch.tensor([0.0, 1.0, 0.0])
        ahead = _turned(ahead, about)
        radius = radius * (RESIZED * torch.randn(count, generator=random)).exp()
        centre = centre + SHIFTED * radius[:, None] * torch.randn(count, 3, generator=random)
    frame = GridFrame.facing(up, ahead, centre, radius)
    grids = grids_of(frame, points, known, Rays(scans.origins, scans.directions), until, random)
    rotation = frame.axes.transpose(1, 2) @ scans.rotation
    turn = torch.atan2(rotation[:, 0, 2] - rotation[:, 2, 0], rotation[:, 0, 0] + rotation[:, 2, 2])
    about = torch.stack([torch.zeros(count), turn, torch.zeros(count)], dim=-1)
    tilt = roma.rotmat_to_rotvec(rotation @ roma.rotvec_to_rotmat(about).transpose(1, 2))
    shift = frame.points(scans.translation[:, None])[:, 0]
    size = (scans.scale / radius).log()
    return Views(grids, turn, torch.cat([shift, size[:, None], tilt[:, [0, 2]]], dim=1))


def _turned(vectors: Float[Tensor, "b 3"], about: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
    return torch.einsum("bij,bj->bi", roma.rotvec_to_rotmat(about), vectors)


def _cut(points: Tensor, centre: Tensor, random: torch.Generator) -> Tensor:
    """Returns which points are left where a plane hides up to half of a scan's breadth."""
    count = len(points)
    normal = normalize(torch.randn(count, 3, generator=random), dim=-1)
    height = torch.einsum("bnj,bj->bn", points - centre[:, None], normal)
    low, high = height.amin(1), height.amax(1)
    plane = low + (high - low) * (0.5 + 0.5 * torch.rand(count, generator=random))
    cut = torch.rand(count, generator=random) < CUT
    return (height <= plane[:, None]) | ~cut[:, None]


def _sparse(known: Tensor, random: torch.Generator) -> Tensor:
    """Returns which points are left where some scans have few."""
    exponent = 1.5 * torch.rand(len(known), generator=random) * (torch.rand(len(known), generator=random) < SPARSE)
    return torch.rand(known.shape, generator=random) < (10**-exponent)[:, None]


def loss_of(network: PlacementNetwork, views: Views) -> Tensor:
    """Returns how unlikely the true placements are."""
    logits, mean, log_deviation = network(views.grids)
    truth = softmax(-0.5 * (_apart(views.turn).rad2deg() / TURN_DEVIATION).square(), dim=-1)
    turn = -(truth * log_softmax(logits, dim=-1)).sum(-1).mean()
    off = (views.place - mean) / log_deviation.exp()
    place = (0.5 * off.square() + log_deviation).sum(-1).mean()
    return turn + PLACE_WEIGHT * place


def _apart(turn: Float[Tensor, "b"]) -> Float[Tensor, "b turns"]:
    """Returns how far each of the network's turns is from the true one, in radians."""
    turns = torch.arange(TURN_BINS) * (2 * math.pi / TURN_BINS)
    return _difference(turn[:, None], turns)


def _difference(first: Tensor, second: Tensor) -> Tensor:
    """Returns the angles between directions, from 0 to π."""
    return torch.atan2((first - second).sin(), (first - second).cos()).abs()


def trained(scans: TrainingScans, steps: int, seed: int, progress: Callable[[int], None]) -> PlacementNetwork:
    """Trains on all but the last scans; `progress` takes the number of steps that are done."""
    torch.manual_seed(seed)
    random = torch.Generator().manual_seed(seed)
    network = PlacementNetwork()
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=WEIGHT_DECAY)
    for step in range(1, steps + 1):
        fall = (1 + math.cos(math.pi * (step - 1) / steps)) / 2
        optimiser.param_groups[0]["lr"] = LEARNING_RATE * fall * min(1.0, step / WARM_UP)
        chosen = torch.randint(len(scans) - VALIDATION, (BATCH,), generator=random)
        loss = loss_of(network, views_of(scans[chosen], random, varied=True))
        optimiser.zero_grad()
        loss.backward()
        clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        progress(step)
    return network.eval()


@torch.no_grad()
def validated(network: PlacementNetwork, scans: TrainingScans) -> dict[str, float]:
    """Returns errors on the last scans: medians, and how often one of the six likeliest turns is right."""
    views = views_of(scans[slice(-VALIDATION, None)], torch.Generator().manual_seed(1), varied=False)
    logits, mean, _ = network(views.grids)
    likeliest = likeliest_turns(logits.softmax(-1), LIKELY)
    degrees = _difference(views.turn[:, None], likeliest).rad2deg()
    off = (views.place - mean).abs()
    return {
        "loss": round(float(loss_of(network, views)), 3),
        "one_of_six_turns_within_5_degrees": round(float((degrees.amin(1) < 5).float().mean()), 3),
        "centre_percent_of_radius": round(100 * float(off[:, :3].norm(dim=-1).median()), 2),
        "size_percent": round(100 * float(off[:, 3].median()), 2),
        "tilt_degrees": round(float(off[:, 4:].norm(dim=-1).median().rad2deg()), 2),
    }
