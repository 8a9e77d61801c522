"""Where a fit to a scan starts: at placements that a network finds likely, or turned and sized in many ways."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import roma
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from distrace.data.scan import Scan
from distrace.fields.decoder import Decoder
from distrace.fields.precision import BFloat16Decoder
from distrace.fitting.placement_network import PlacementGuess, PlacementNetwork, guess_placement
from distrace.fitting.scan_residuals import PlacedCode, PlacementPrior, ScanProblem, ScanSample
from distrace.fitting.solver import charbonnier
from distrace.fitting.starts import Hints, nearest_codes
from distrace.pose import Similarity
from distrace.prior import Prior
from distrace.vectors import perpendicular

LIKELY = 6  # placements of the mean shape that the fit starts from
NEAREST = 2  # starts from the training shapes that are nearest to the scan, …
NEAREST_PLACES = 2  # … at each of the likeliest placements
HINT_POINTS = 80  # of the surface, and of free space, that tell which are nearest
HINT_MARGIN = 0.05  # radii of the unit sphere before the end of a ray, from where space may not be free
TRIED_TURNS = 12  # about up, without a network
TRIED_SIZES = (1.05, 1.4)  # of the unit sphere, in radii of the scan, without a network
DEVIATION_FACTOR = 0.6  # × the network's deviations: residuals of points are not as independent as they count
LEAST_DEVIATION = 0.02


@dataclass(frozen=True)
class Starts:
    """Where to start, and where each start is likely to end; states are numbered from 0."""

    states: list[PlacedCode]
    placement_priors: list[PlacementPrior]
    evaluations: int = 0  # of the field

    def __add__(self, other: "Starts") -> "Starts":
        states = [*self.states, *other.states]
        numbered = [replace(state, start=number) for number, state in enumerate(states)]
        return Starts(numbered, [*self.placement_priors, *other.placement_priors], self.evaluations + other.evaluations)

    def best(self, count: int, problem_of: Callable[[Sequence[PlacementPrior]], ScanProblem]) -> "Starts":
        """Returns the `count` states of the least loss."""
        if len(self.states) <= count:
            return self
        problem = problem_of(self.placement_priors)
        losses = torch.tensor([each.loss(1.0, charbonnier) for each in problem.residuals(self.states)])
        chosen = losses.argsort()[:count].tolist()
        states = [replace(self.states[k], start=number) for number, k in enumerate(chosen)]
        evaluations = self.evaluations + sum(problem.evaluations.values())
        return Starts(states, [self.placement_priors[k] for k in chosen], evaluations)


def find_starts(
    scan: Scan,
    prior: Prior,
    decoder: Decoder | BFloat16Decoder,
    network: PlacementNetwork | None,
    place: Similarity | None,
    problem_of: Callable[[Sequence[PlacementPrior]], ScanProblem],
    seed: int,
) -> Starts:
    """Returns the mean shape at likely placements, or at `place`, and the nearest training shapes at the best of them.

    `problem_of` takes what is likely of the states that are compared.
    """
    if place is not None:
        places = Starts([PlacedCode.at(place, prior.mean)], [placement_prior(place, scan)])
    elif network is not None:
        places = _of_network(scan, prior, network, seed).best(LIKELY, problem_of)
    else:
        places = _all_about(scan, prior).best(2 * LIKELY, problem_of)
    nearest = Starts([], [])
    for state, likely in list(zip(places.states, places.placement_priors))[:NEAREST_PLACES]:
        hints = _hints(scan, state.place, seed)
        codes, evaluations = nearest_codes(decoder, prior.codes, hints, NEAREST)
        states = [PlacedCode.at(state.place, code) for code in codes]
        nearest += Starts(states, [likely] * len(states), evaluations)
    return places + nearest


def _hints(scan: Scan, place: Similarity, seed: int) -> Hints:
    """Returns points of the scan and of free space in the frame of an object."""
    random = torch.Generator().manual_seed(seed)
    sample = ScanSample.drawn(scan, HINT_POINTS, HINT_POINTS, random)
    rays = place.rays_in_object(sample.rays)
    until = sample.until / place.scale - HINT_MARGIN
    return Hints.of(ScanSample(place.to_object(sample.points), rays, until, sample.free), random)


def placement_prior(place: Similarity, scan: Scan, guess: PlacementGuess | None = None) -> PlacementPrior:
    """Returns what is likely of an end: a guess's centre and size, and the candidate of up that the start has."""
    axis = place.rotation[:, 1]
    up = scan.ups[(scan.ups @ axis).argmax()] if len(scan.ups) else None
    likely = PlacementPrior(float(place.scale), place.translation, up)
    if guess is None:
        return likely
    return replace(
        likely,
        size_deviation=max(DEVIATION_FACTOR * guess.size_deviation, LEAST_DEVIATION),
        centre_deviation=max(DEVIATION_FACTOR * guess.centre_deviation, LEAST_DEVIATION),
    )


def _of_network(scan: Scan, prior: Prior, network: PlacementNetwork, seed: int) -> Starts:
    """Returns the mean shape at the likeliest placements, the best of each up first."""
    states = []
    placement_priors = []
    on_cpu = scan.to("cpu")
    knows_up = len(scan.ups) > 0  # the network has seen upright objects alone
    for up in _candidate_ups(on_cpu):
        guess = guess_placement(network, on_cpu, up, seed)
        for place in guess.places(LIKELY):
            place = place.to(prior.mean.device)
            states.append(PlacedCode.at(place, prior.mean, len(states)))
            placement_priors.append(placement_prior(place, scan, guess if knows_up else None))
    return Starts(states, placement_priors)


def _all_about(scan: Scan, prior: Prior) -> Starts:
    """Returns the mean shape in all turns about up, in two sizes, about the middle of the scan."""
    states = []
    placement_priors = []
    for up in _candidate_ups(scan):
        for rotation in turns_about(up):
            along = scan.points @ rotation
            middle = rotation @ (along.quantile(0.02, dim=0) + along.quantile(0.98, dim=0)) / 2
            for size in TRIED_SIZES:
                place = Similarity(rotation, middle, middle.new_tensor(size * scan.radius))
                states.append(PlacedCode.at(place, prior.mean, len(states)))
                placement_priors.append(placement_prior(place, scan))
    return Starts(states, placement_priors)


def _candidate_ups(scan: Scan) -> Float[Tensor, "k 3"]:
    return scan.ups if len(scan.ups) else axes_around().to(scan.points)


def turns_about(up: Float[Tensor, "3"]) -> Float[Tensor, "turns 3 3"]:
    """Returns rotations that take the y axis to `up`."""
    side = perpendicular(up)
    upright = torch.stack([torch.linalg.cross(up, side), up, side], dim=1)
    angles = torch.arange(TRIED_TURNS).to(up) * (2 * math.pi / TRIED_TURNS)
    return upright @ roma.rotvec_to_rotmat(angles[:, None] * angles.new_tensor([0.0, 1.0, 0.0]))


def axes_around() -> Float[Tensor, "26 3"]:
    """Returns unit vectors in all directions: to the faces, edges and corners of a cube."""
    directions = torch.cartesian_prod(*(torch.tensor([-1.0, 0.0, 1.0]),) * 3)
    return normalize(directions[directions.norm(dim=-1) > 0], dim=-1)
