"""Training a colour decoder and the colour codes of textured shapes, whose shapes stay as they are.

A few shapes have a few colours. So each material also gets colours at random, and each such palette a code of its own.
"""

import colorsys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from distrace.data.coloured_points import ColouredPoints
from distrace.fields.colour import ColourDecoder, ColourSpecs


@dataclass(frozen=True)
class ColourTrainConfig:
    """Adam with a rate that falls to zero along a cosine."""

    steps: int = 5000
    palettes: int = 12  # of each shape: the first is its own
    palettes_per_step: int = 32
    points_per_palette: int = 64
    learning_rate: float = 1e-3
    code_learning_rate: float = 1e-2
    code_penalty: float = 1e-3  # of the mean squared entry
    code_deviation: float = 0.1  # standard deviation of the initial codes' entries
    specs: ColourSpecs = ColourSpecs()
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.steps, self.palettes, self.palettes_per_step, self.points_per_palette) < 1:
            raise ValueError(f"{self} was given; steps, palettes and points must each be at least 1")


@dataclass
class ColourTraining:
    """A colour decoder, and a code for each palette: those of a shape follow each other."""

    decoder: ColourDecoder
    codes: nn.Parameter  # [shapes × palettes, length]


def start_colours(shapes: int, config: ColourTrainConfig, device: torch.device) -> ColourTraining:
    """Returns a fresh decoder and codes, from the configuration's seed."""
    torch.manual_seed(config.seed)
    decoder = ColourDecoder(config.specs).to(device)
    codes = config.code_deviation * torch.randn(shapes * config.palettes, config.specs.colour_code)
    return ColourTraining(decoder, nn.Parameter(codes.to(device)))


def train_colours(
    training: ColourTraining,
    samples: Sequence[ColouredPoints],
    shape_codes: Float[Tensor, "shapes length"],
    config: ColourTrainConfig,
) -> Iterator[float]:
    """Trains in place on the mean absolute difference of sRGB colours, and yields the loss of every step."""
    device = training.codes.device
    points = [torch.from_numpy(np.concatenate([each.points, each.normals], axis=1)).to(device) for each in samples]
    colours = [_in_palettes(each, config, number).to(device) for number, each in enumerate(samples)]
    groups = [{"params": list(training.decoder.parameters())}, {"params": [training.codes]}]
    optimiser = torch.optim.Adam(groups)
    random = torch.Generator().manual_seed(config.seed)
    for step in range(config.steps):
        fall = 0.5 + 0.5 * float(np.cos(np.pi * step / config.steps))
        optimiser.param_groups[0]["lr"] = fall * config.learning_rate
        optimiser.param_groups[1]["lr"] = fall * config.code_learning_rate
        palette = torch.randint(len(training.codes), (config.palettes_per_step,), generator=random)
        placed, target = _batch(points, colours, palette, config, random)
        shape = (palette // config.palettes).to(device)
        codes = training.codes[palette.to(device)]
        found = training.decoder(placed[..., :3], placed[..., 3:], shape_codes[shape][:, None], codes[:, None])
        loss = (found - target).abs().mean()
        optimiser.zero_grad()
        (loss + config.code_penalty * codes.square().mean()).backward()
        optimiser.step()
        yield loss.item()


def _batch(
    points: Sequence[Float[Tensor, "_ 6"]],
    colours: Sequence[Float[Tensor, "palettes _ 3"]],
    palette: Int[Tensor, "n"],
    config: ColourTrainConfig,
    random: torch.Generator,
) -> tuple[Float[Tensor, "n points 6"], Float[Tensor, "n points 3"]]:
    """Returns random points of some palettes, with normals, and their colours."""
    placed = []
    targets = []
    for number in palette.tolist():
        shape, of_shape = divmod(number, config.palettes)
        rows = torch.randint(len(points[shape]), (config.points_per_palette,), generator=random).to(
            points[shape].device
        )
        placed.append(points[shape][rows])
        targets.append(colours[shape][of_shape, rows])
    return torch.stack(placed), torch.stack(targets)


def _in_palettes(samples: ColouredPoints, config: ColourTrainConfig, number: int) -> Float[Tensor, "palettes n 3"]:
    """Returns a shape's own colours, and those with another colour for each material."""
    random = np.random.default_rng((config.seed, number))
    own = samples.colours
    _, patch = np.unique(samples.patch, return_inverse=True)
    counts = np.maximum(np.bincount(patch), 1)
    mean = np.stack([np.bincount(patch, own[:, channel]) / counts for channel in range(3)], axis=1)
    brightness = own.mean(1, keepdims=True) / np.maximum(mean.mean(1), 0.02)[patch, None]  # keeps the image's pattern
    palettes = [own]
    for _ in range(config.palettes - 1):
        chosen = np.array([_random_colour(random) for _ in counts])
        palettes.append((chosen[patch] * brightness).clip(0, 1).astype(np.float32))
    return torch.from_numpy(np.stack(palettes))


def _random_colour(random: np.random.Generator) -> tuple[float, float, float]:
    """Returns a colour as furniture has it: more often pale or dark than bright."""
    return colorsys.hsv_to_rgb(random.random(), random.random() ** 1.5, random.uniform(0.05, 0.95))
