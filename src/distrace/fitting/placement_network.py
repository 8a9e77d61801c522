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
from distrace.pose import Similarity
from distrace.rays import Rays

FILE = "placement.safetensors"  # in a model's folder
TURNS = 72  # of which each has its probability
CELLS = 40  # along each side of the grid
SLICES = 8  # of height
REACH = 1.6  # from the middle to the border of the grid, in radii of the scan
RAY_SAMPLES = 4  # points of free space on each ray
UNTIL = 0.03  # radii before a ray's end, from where space may not be free
POINTS = 768  # of the surface in a grid, at most, and as many rays
DRAWS = 6  # grids of a scan, of other points, whose answers are averaged
DRAW_TURN = 1  # turns of the grid, between one draw and the next of three
NEAR = 3  # turns beside a likely one that lead to the same end


@dataclass(frozen=True)
class Frame:
    """Where grids lie: axes (right, up, towards the viewer) as columns, middle and unit of length, of each."""

    axes: Float[Tensor, "b 3 3"]
    centre: Float[Tensor, "b 3"]
    radius: Float[Tensor, "b"]

    @staticmethod
    def facing(up: Float[Tensor, "b 3"], ahead: Float[Tensor, "b 3"], centre: Tensor, radius: Tensor) -> "Frame":
        """Returns upright frames whose z axis points against `ahead`."""
        level = ahead - (ahead * up).sum(-1, keepdim=True) * up
        back = -normalize(level, dim=-1)
        return Frame(torch.stack([torch.linalg.cross(up, back), up, back], dim=-1), centre, radius)

    def points(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        return (points - self.centre[:, None]) @ self.axes / self.radius[:, None, None]

    def directions(self, directions: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        return directions @ self.axes


def grids_of(
    frame: Frame,
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
    origins = frame.points(rays.origins)
    directions = frame.directions(rays.directions)
    middle = -(origins * directions).sum(-1)
    nearest = (origins + middle[..., None] * directions).square().sum(-1)
    half = (1.5 * REACH**2 - nearest).clamp_min(0).sqrt()
    near = (middle - half).clamp_min(0)
    far = torch.minimum(middle + half, until / frame.radius[:, None] - UNTIL)
    shares = (torch.arange(RAY_SAMPLES) + torch.rand(*near.shape, RAY_SAMPLES, generator=random)) / RAY_SAMPLES
    t = near[..., None] + (far - near)[..., None] * shares.to(near)
    samples = origins[:, :, None] + t.nan_to_num(0.0)[..., None] * directions[:, :, None]
    passes = (near < far)[..., None].expand(t.shape)
    free = _counts(samples.flatten(1, 2), passes.flatten(1, 2))
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
        self.turn = nn.Linear(256, TURNS)
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
        step = 2 * math.pi / TURNS
        smooth = self.turns + self.turns.roll(1) + self.turns.roll(-1)
        beside = torch.arange(-2, 3)
        found = []
        for _ in range(count):
            best = int(smooth.argmax())
            weights = self.turns[(best + beside) % TURNS]
            offset = float((weights * beside).sum() / weights.sum().clamp_min(1e-9))
            turn = self.centre.new_tensor([0.0, (best + offset) * step, 0.0])
            rotation = self.up_frame @ roma.rotvec_to_rotmat(turn)
            found.append(Similarity(rotation, self.centre, self.size))
            smooth[(best + torch.arange(-NEAR, NEAR + 1)) % TURNS] = -1.0
        return found


@torch.no_grad()
def guess_placement(network: PlacementNetwork, scan: Scan, up: Float[Tensor, "3"], seed: int = 0) -> PlacementGuess:
    """Returns the guess for an object whose own up is near `up`."""
    random = torch.Generator().manual_seed(seed)
    ahead = _ahead(scan, up)
    shifts = [DRAW_TURN * (draw % 3 - 1) for draw in range(DRAWS)]
    about = torch.tensor(shifts)[:, None] * (2 * math.pi / TURNS) * up
    directions = torch.einsum("bij,j->bi", roma.rotvec_to_rotmat(about), ahead)
    centres = scan.centre.expand(DRAWS, 3)
    frame = Frame.facing(up.expand(DRAWS, 3), directions, centres, scan.points.new_full((DRAWS,), scan.radius))
    logits, mean, log_deviation = network(_drawn_grids(scan, frame, random))
    each = logits.softmax(-1)
    turns = torch.stack([one.roll(shift) for one, shift in zip(each, shifts, strict=True)]).mean(0)
    axes = frame.axes[1]  # of the draw that is not turned
    tilt = torch.zeros(DRAWS, 3)
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


def _drawn_grids(scan: Scan, frame: Frame, random: torch.Generator) -> Float[Tensor, "b channels cells cells"]:
    points = torch.stack([_rows(len(scan.points), random) for _ in range(DRAWS)])
    rays = torch.stack([_rows(len(scan.free_until), random) for _ in range(DRAWS)])
    known = torch.ones_like(points, dtype=torch.bool)
    return grids_of(frame, scan.points[points], known, scan.free[rays], scan.free_until[rays], random)


def _rows(count: int, random: torch.Generator) -> Tensor:
    return torch.randperm(count, generator=random)[:POINTS]


def _ahead(scan: Scan, up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Returns the level direction from the viewer to the object; of a cloud, any."""
    side = torch.linalg.cross(up, up.roll(1) + 0.1)
    if not scan.views:
        return side
    ahead = scan.centre - scan.views[0].camera.T_world_camera[:3, 3]
    level = ahead - (ahead @ up) * up
    return level if level.norm() > 0.05 * ahead.norm() else side


def load_placement_network(model: str | Path) -> PlacementNetwork | None:
    """Returns the network of a bundled model or of a folder; None where it has none. Raises `ValueError` for damage."""
    path = model_folder(model) / FILE
    if not path.is_file():
        return None
    network = PlacementNetwork()
    with error_context(f"{path} is not a safetensors file of a placement network", path):
        network.load_state_dict(safetensors.torch.load_file(path))  # copies half precision into single
        if not all(tensor.isfinite().all() for tensor in network.state_dict().values()):
            raise ValueError("it has values that are not finite")
    return network.eval().requires_grad_(False)
