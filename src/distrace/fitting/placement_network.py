"""A small network that tells how an object of one class is placed in a scan; simulated scans have trained it.

It sees a scan from above: a grid of cells, whose channels are slices of height, with the points of the surface and of
free space in each. It tells the turn about up as a distribution, since many shapes look alike from two sides; and the
centre, the size and the tilt with their deviations.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import roma
import safetensors.torch
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from distrace.checkpoints.model import model_folder
from distrace.data.scan import Scan
from distrace.errors import error_context
from distrace.files import save_tensors
from distrace.fitting.ray_sampling import drawn
from distrace.pose import Similarity
from distrace.rays import Rays, meet_sphere
from distrace.vectors import perpendicular

PLACEMENT_FILE = "placement.safetensors"  # in a model's folder
TURN_BINS = 72  # of which each has its probability
CELLS = 40  # along each side of the grid
SLICES = 8  # of height
REACH = 1.6  # from the middle to the border of the grid, in radii of the scan
FREE_REACH = 1.5**0.5 * REACH  # radii of the scan, of the sphere in which free space is looked at
RAY_SAMPLES = 4  # points of free space on each ray
FREE_MARGIN = 0.03  # radii before a ray's end, from where space may not be free
POINTS = 768  # of the surface in a grid, at most, and as many rays
RESAMPLINGS = 6  # grids of a scan, of other points, whose answers are averaged
RESAMPLING_TURN = 1  # turns of the grid, between one draw and the next of three
SUPPRESSED_BINS = 3  # turns beside a likely one that lead to the same end


@dataclass(frozen=True)
class GridFrame:
    """Where grids lie: axes (right, up, towards the viewer) as columns, middle and unit of length, of each."""

    axes: Float[Tensor, "b 3 3"]
    centre: Float[Tensor, "b 3"]
    radius: Float[Tensor, "b"]

    @staticmethod
    def facing(up: Float[Tensor, "b 3"], ahead: Float[Tensor, "b 3"], centre: Tensor, radius: Tensor) -> "GridFrame":
        """Returns upright frames whose z axis points against `ahead`."""
        level = ahead - (ahead * up).sum(-1, keepdim=True) * up
        back = -normalize(level, dim=-1)
        return GridFrame(torch.stack([torch.linalg.cross(up, back), up, back], dim=-1), centre, radius)

    def points(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        return (points - self.centre[:, None]) @ self.axes / self.radius[:, None, None]

    def directions(self, directions: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        return directions @ self.axes


def grids_of(
    frame: GridFrame,
    points: Float[Tensor, "b n 3"],
    known: Bool[Tensor, "b n"],
    rays: Rays,
    until: Float[Tensor, "b m"],
    random: torch.Generator,
) -> Float[Tensor, "b channels cells cells"]:
    """Returns the logarithm of 1 + the count of surface points and of free points in each cell.

    `rays` [b, m] are free up to a distance; those with `until` 0 say nothing.
    """
    surface = _counts(frame.points(points), known)
    rays = Rays(frame.points(rays.origins), frame.directions(rays.directions))
    bounds = meet_sphere(rays, FREE_REACH)
    near = bounds.near
    far = bounds.far.minimum(until / frame.radius[:, None] - FREE_MARGIN)
    shares = (torch.arange(RAY_SAMPLES) + torch.rand(*near.shape, RAY_SAMPLES, generator=random)) / RAY_SAMPLES
    passes = near < far
    near, far = near.where(passes, 0.0), far.where(passes, 0.0)
    t = near[..., None] + (far - near)[..., None] * shares.to(near)
    samples = rays.origins[:, :, None] + t[..., None] * rays.directions[:, :, None]
    free = _counts(samples.flatten(1, 2), passes[..., None].expand(t.shape).flatten(1, 2))
    return torch.cat([surface, free], dim=1).log1p()


def _counts(points: Float[Tensor, "b n 3"], valid: Bool[Tensor, "b n"]) -> Float[Tensor, "b slices cells cells"]:
    """Returns how many of the valid points lie in each cell of [height, depth, breadth]."""
    sizes = torch.tensor([CELLS, SLICES, CELLS]).to(points)
    cell = ((points + REACH) * (sizes / (2 * REACH))).floor().long()
    inside = valid & (cell >= 0).all(-1) & (cell < sizes.long()).all(-1)
    x, y, z = cell.unbind(-1)
    batch = torch.arange(len(points)).to(x)[:, None]
    index = ((batch * SLICES + y) * CELLS + z) * CELLS + x
    counts = points.new_zeros(len(points) * SLICES * CELLS * CELLS)
    counts.scatter_add_(0, index.where(inside, 0).flatten(), inside.to(points).flatten())
    return counts.reshape(-1, SLICES, CELLS, CELLS)


class PlacementNetwork(nn.Module):
    """Takes grids [b, 16, 40, 40]; returns logits of turns [b, 72], and means and log deviations of six numbers [b, 6].

    The numbers are the centre in the grid's frame, the logarithm of the size in radii of the scan, and the tilt: a
    rotation vector's x and z.
    """

    def __init__(self) -> None:
        super().__init__()
        widths = ((2 * SLICES, 32, 2), (32, 64, 2), (64, 96, 1), (96, 128, 2), (128, 128, 1))  # in, out, stride
        self.body = nn.Sequential(*(_convolution(*width) for width in widths))
        self.head = nn.Sequential(nn.Flatten(), nn.Dropout(0.1), nn.Linear(128 * (CELLS // 8) ** 2, 256), nn.ReLU())
        self.turn = nn.Linear(256, TURN_BINS)
        self.place = nn.Linear(256, 12)

    def forward(
        self, grids: Float[Tensor, "b channels cells cells"]
    ) -> tuple[Float[Tensor, "b turns"], Float[Tensor, "b 6"], Float[Tensor, "b 6"]]:
        features = self.head(self.body(grids))
        mean, log_deviation = self.place(features).chunk(2, dim=-1)
        return self.turn(features), mean, log_deviation.clamp(-5, 2)


def _convolution(channels: int, out: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels, out, 3, stride, 1), nn.BatchNorm2d(out), nn.ReLU())


@dataclass(frozen=True)
class PlacementGuess:
    """What the network says of a scan, in the scan's frame and unit."""

    up_frame: Float[Tensor, "3 3"]  # the frame's axes, turned by the tilt: there the object turns about y
    turns: Float[Tensor, "turns"]  # probabilities
    centre: Float[Tensor, "3"]
    size: Float[Tensor, ""]
    centre_deviation: float  # in sizes
    size_deviation: float  # of the logarithm

    def places(self, count: int) -> list[Similarity]:
        """Returns the most likely placements, best first, each of another turn."""
        found = []
        for turn in likeliest_turns(self.turns[None], count)[0]:
            rotation = self.up_frame @ roma.rotvec_to_rotmat(turn * turn.new_tensor([0.0, 1.0, 0.0]))
            found.append(Similarity(rotation, self.centre, self.size))
        return found


def likeliest_turns(probabilities: Float[Tensor, "b turns"], count: int) -> Float[Tensor, "b count"]:
    """Returns the peaks of distributions of turns, in radians, best first; they are at least 20 degrees apart."""
    smooth = probabilities + probabilities.roll(1, -1) + probabilities.roll(-1, -1)
    beside = torch.arange(-2, 3).to(smooth.device)
    suppressed = torch.arange(-SUPPRESSED_BINS, SUPPRESSED_BINS + 1).to(smooth.device)
    found = []
    for _ in range(count):
        best = smooth.argmax(-1, keepdim=True)
        weights = probabilities.gather(-1, (best + beside) % TURN_BINS)
        offset = (weights * beside).sum(-1) / weights.sum(-1).clamp_min(1e-9)
        found.append((best[:, 0] + offset) * (2 * math.pi / TURN_BINS))
        smooth = smooth.scatter(-1, (best + suppressed) % TURN_BINS, -1.0)
    return torch.stack(found, dim=-1)


@torch.no_grad()
def guess_placement(network: PlacementNetwork, scan: Scan, up: Float[Tensor, "3"], seed: int = 0) -> PlacementGuess:
    """Returns the guess for an object whose own up is near `up`."""
    random = torch.Generator().manual_seed(seed)
    ahead = _ahead(scan, up)
    shifts = [RESAMPLING_TURN * (draw % 3 - 1) for draw in range(RESAMPLINGS)]
    about = torch.tensor(shifts)[:, None] * (2 * math.pi / TURN_BINS) * up
    directions = torch.einsum("bij,j->bi", roma.rotvec_to_rotmat(about), ahead)
    centres = scan.centre.expand(RESAMPLINGS, 3)
    frame = GridFrame.facing(
        up.expand(RESAMPLINGS, 3), directions, centres, scan.points.new_full((RESAMPLINGS,), scan.radius)
    )
    logits, mean, log_deviation = network(_drawn_grids(scan, frame, random))
    each = logits.softmax(-1)
    turns = torch.stack([one.roll(shift) for one, shift in zip(each, shifts, strict=True)]).mean(0)
    axes = frame.axes[1]  # of the draw that is not turned
    tilt = torch.zeros(RESAMPLINGS, 3)
    tilt[:, [0, 2]] = mean[:, 4:]
    tilt = torch.einsum("bij,bj->bi", frame.axes, tilt).mean(0) @ axes  # its y is about 0
    centre = torch.einsum("bij,bj->bi", frame.axes, mean[:, :3]).mean(0)
    size = scan.radius * mean[:, 3].mean().exp()
    deviation = log_deviation.exp().mean(0)
    return PlacementGuess(
        axes @ roma.rotvec_to_rotmat(tilt),
        turns,
        scan.centre + scan.radius * centre,
        size,
        float(deviation[:3].mean() * scan.radius / size),
        float(deviation[3]),
    )


def _drawn_grids(scan: Scan, frame: GridFrame, random: torch.Generator) -> Float[Tensor, "b channels cells cells"]:
    points = torch.stack([drawn(torch.arange(len(scan.points)), POINTS, random) for _ in range(RESAMPLINGS)])
    rays = torch.stack([drawn(torch.arange(len(scan.free_until)), POINTS, random) for _ in range(RESAMPLINGS)])
    known = torch.ones_like(points, dtype=torch.bool)
    return grids_of(frame, scan.points[points], known, scan.free[rays], scan.free_until[rays], random)


def _ahead(scan: Scan, up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Returns the level direction from the viewer to the object; of a cloud, any."""
    side = perpendicular(up)
    if not scan.views:
        return side
    ahead = scan.centre - scan.views[0].camera.T_world_camera[:3, 3]
    level = ahead - (ahead @ up) * up
    return level if level.norm() > 0.05 * ahead.norm() else side


def load_placement_network(model: str | Path) -> PlacementNetwork | None:
    """Returns the network of a bundled model or of a folder; None where it has none. Raises `ValueError` for damage."""
    path = model_folder(model) / PLACEMENT_FILE
    if not path.is_file():
        return None
    network = PlacementNetwork()
    with error_context(f"{path} is not a safetensors file of a placement network", path):
        network.load_state_dict(safetensors.torch.load_file(path))  # copies half precision into single
        if not all(tensor.isfinite().all() for tensor in network.state_dict().values()):
            raise ValueError("it has values that are not finite")
    return network.eval().requires_grad_(False)


def save_placement_network(path: Path, network: PlacementNetwork) -> None:
    """Writes a placement network in half precision, as a model's folder has it."""
    save_tensors(path, network.state_dict())
