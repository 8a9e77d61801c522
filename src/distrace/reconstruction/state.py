"""The schedule and the state of a reconstruction, and its checkpoint: everything needed to go on after a stop."""

import operator
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.errors import error_context
from distrace.files import atomic_write
from distrace.pose import exp_se3
from distrace.reconstruction.networks import ColourNetwork, SurfaceNetwork, SurfaceSpecs

NAME = "checkpoint.pt"
NUMBERS = ("step", "seconds", "evaluations", "loss_history")  # that a checkpoint holds as they are
MODULES = ("surface", "colour", "optimiser")


@dataclass(frozen=True)
class ReconstructConfig:
    """The schedule. Sizes are the longer sides of the images, in pixels: coarse ones, then finer ones."""

    steps: int = 16_000
    initial_steps: int = 1500  # before, of the surface alone, towards the visual hull and consistent depths
    sizes: tuple[int, ...] = (160, 320)
    rays: int = 1024  # of a step: half of the object, half around it
    learning_rate: float = 1e-3  # of the colour network; …
    surface_rate: float = 0.5  # … × this of the surface network; …
    camera_rate: float = 0.1  # … × this of the cameras' motions: 0 where cameras are known exactly
    final_rate: float = 0.05  # × as much at the end; the rate falls exponentially
    colour: float = 1.0  # weights of the loss terms, to `eikonal`, and `depths`
    patches: float = 0.5
    outline: float = 200.0
    eikonal: float = 1.0
    eikonal_with_depths: float = 10.0  # × `eikonal`: untextured parts stay smooth, and the rest is near
    depths: float = 20.0
    sharpness: float = 100.0  # of outlines at first, per radius: it doubles …
    sharpness_doublings: int = 3  # … so often, evenly over the steps
    colour_warmup: float = 0.05  # share of the steps, at first, in which colours do not change the surface
    refinement_steps: int = 1000  # after all others, of the colours alone …
    refinement_pixels: int = 4096  # … and the pixels of each
    shape_from_colour: bool = True  # without, only outlines shape the surface: a visual hull
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.rays < 4 or not self.sizes or min(self.sizes) < 8:
            given = f"{self.steps} steps of {self.rays} rays and images of {self.sizes} pixels"
            raise ValueError(f"{given} were given; at least 1 step, 4 rays and 8 pixels are needed")
        if self.refinement_steps < 0 or self.refinement_pixels < 1:
            given = f"{self.refinement_steps} refinement steps of {self.refinement_pixels} pixels"
            raise ValueError(f"{given} were given; at least 0 steps and 1 pixel are needed")

    @property
    def total(self) -> int:
        """Steps, with those of the colour refinement."""
        return self.steps + self.refinement_steps

    def weight(self, term: str, with_depths: bool) -> float:
        """The weight of a loss term."""
        return getattr(self, term) * (self.eikonal_with_depths if with_depths and term == "eikonal" else 1.0)

    def rate_at(self, step: int) -> float:
        """The learning rate, which falls exponentially, and once more in the colour refinement."""
        part = step / self.steps if step < self.steps else (step - self.steps) / self.refinement_steps
        return self.learning_rate * self.final_rate**part

    def sharpness_at(self, step: int) -> float:
        """The sharpness of outlines, per radius."""
        return self.sharpness * 2.0 ** (step * (self.sharpness_doublings + 1) // self.steps)

    def shapes_at(self, step: int) -> bool:
        """Whether colours change the surface."""
        return self.shape_from_colour and step >= self.colour_warmup * self.steps

    def size_at(self, step: int) -> int:
        """The longer side of the images, in pixels."""
        return self.sizes[step * len(self.sizes) // self.steps]


@dataclass
class Reconstruction:
    """Everything that a run changes, and that a checkpoint holds."""

    surface: SurfaceNetwork
    colour: ColourNetwork
    camera_steps: Float[Tensor, "views 6"]  # the cameras' motions, as twists
    optimiser: torch.optim.Adam
    step: int = 0
    seconds: float = 0.0  # of all steps
    evaluations: int = 0  # of the surface network
    loss_history: dict[str, list[float]] = field(default_factory=dict)  # of each term

    @staticmethod
    def fresh(specs: SurfaceSpecs, config: ReconstructConfig, views: int, device: torch.device) -> "Reconstruction":
        """The state before the first step."""
        torch.manual_seed(config.seed)
        surface = SurfaceNetwork(specs).to(device)
        colour = ColourNetwork(specs).to(device)
        camera_steps = torch.zeros(views, 6, device=device, requires_grad=True)
        groups = [
            {"params": list(surface.parameters()), "share": config.surface_rate},
            {"params": list(colour.parameters()), "share": 1.0},
            {"params": [camera_steps], "share": config.camera_rate},
        ]
        return Reconstruction(surface, colour, camera_steps, torch.optim.Adam(groups, config.learning_rate))

    @property
    def device(self) -> torch.device:
        return self.surface.last.weight.device

    @property
    def relative_steps(self) -> Float[Tensor, "views 6"]:
        """The cameras' steps without their mean, which would move the object away from held-out views."""
        return self.camera_steps - self.camera_steps.mean(0)

    def motions(self) -> Float[Tensor, "views 4 4"]:
        """The cameras' motions, in the order of the views."""
        steps = self.relative_steps
        return exp_se3(steps[:, :3], steps[:, 3:])


def fingerprint(photograph: Photograph) -> str:
    """Its name, and a checksum of its pixels, mask and camera."""
    camera = torch.cat([photograph.camera.intrinsics.flatten(), photograph.camera.T_world_camera.flatten()])
    parts = ((255 * photograph.image).round().byte(), photograph.known_mask, (1e4 * camera.double()).round().long())
    checksum = 0
    for part in parts:
        checksum = zlib.crc32(part.contiguous().numpy().tobytes(), checksum)
    return f"{photograph.name} {checksum:08x}"


def save_reconstruction(
    folder: Path, state: Reconstruction, config: ReconstructConfig, fingerprints: Sequence[str]
) -> None:
    """Replaces the folder's checkpoint in one step. `fingerprints` are those of the photographs."""
    content = {
        "settings": _settings(config, state.surface.specs, fingerprints),
        "camera_steps": state.camera_steps.detach(),
        **{name: getattr(state, name) for name in NUMBERS},
        **{name: getattr(state, name).state_dict() for name in MODULES},
    }
    with atomic_write(folder / NAME) as file:
        torch.save(content, file)


def load_reconstruction(
    folder: Path, config: ReconstructConfig, specs: SurfaceSpecs, fingerprints: Sequence[str], device: torch.device
) -> Reconstruction:
    """The state of the folder's checkpoint, or a fresh one where there is none.

    Raises `ValueError` for a damaged checkpoint, or one of other photographs or settings.
    """
    state = Reconstruction.fresh(specs, config, len(fingerprints), device)
    path = folder / NAME
    if not path.exists():
        return state
    with error_context(f"{path} is not a checkpoint of a reconstruction; move it away to start afresh"):
        content = torch.load(path, map_location=device, weights_only=True)
        settings = _settings(config, specs, fingerprints)
        changed = [name for name, value in settings.items() if content["settings"].get(name) != value]
        if not changed:
            state.camera_steps.data.copy_(content["camera_steps"])
            state.step = operator.index(content["step"])
            state.seconds = float(content["seconds"])
            state.evaluations = operator.index(content["evaluations"])
            state.loss_history = {
                str(name): [float(value) for value in values] for name, values in content["loss_history"].items()
            }
            for name in MODULES:
                getattr(state, name).load_state_dict(content[name])
    if changed:
        raise ValueError(f"{path} is of a run with other {', '.join(changed)}; give the same, or another --out")
    return state


def _settings(config: ReconstructConfig, specs: SurfaceSpecs, fingerprints: Sequence[str]) -> dict[str, object]:
    """All that must stay the same when a run goes on."""
    return {"photographs": list(fingerprints), **asdict(config), **asdict(specs)}
