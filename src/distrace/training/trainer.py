"""Training a DeepSDF auto-decoder: the network and one code per shape, together (Park et al., CVPR 2019, section 4)."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized

from distrace.checkpoints.model import Model
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.training.batches import Samples, Side
from distrace.training.config import TrainConfig
from distrace.training.cuda_graph import GraphedStep
from distrace.training.distributed import ALONE, Processes
from distrace.training.fine_tuning import Distillation
from distrace.training.losses import clamped_loss, record, training_loss


@dataclass
class Training:
    """The state of a run: a checkpoint holds all of it."""

    decoder: Decoder
    codes: nn.Parameter  # [shapes, length]; in a run of several processes those of this one's shapes
    optimiser: torch.optim.Adam
    step: int = 0
    losses: list[float] = field(default_factory=list)  # the mean of each STEPS_PER_LOSS steps; the last may have fewer


@dataclass(frozen=True)
class TrainingStep:
    """One step done: its loss, and how long it took."""

    step: int
    loss: float
    seconds: float


def start_training(shapes: int, specs: NetworkSpecs, config: TrainConfig, device: torch.device) -> Training:
    """A fresh network and codes, from the configuration's seed."""
    torch.manual_seed(config.seed)
    decoder = Decoder(specs).to(device)
    codes = nn.Parameter(config.code_deviation * torch.randn(shapes, specs.code_length).to(device))
    return Training(decoder, codes, adam(decoder, codes))


def adam(decoder: Decoder, codes: nn.Parameter) -> torch.optim.Adam:
    """An optimiser of two groups: the decoder, and the codes."""
    groups = [{"params": list(decoder.parameters())}, {"params": [codes]}]
    return torch.optim.Adam(groups, lr=0.0, fused=True)


@torch.no_grad()
def begin_with(training: Training, names: list[str], model: Model) -> None:
    """Copies a model's weights, and its codes of shapes of these names; other codes start as `Model.codes_of` says."""
    for layer in range(training.decoder.depth):
        own, learnt = (getattr(decoder, f"lin{layer}") for decoder in (training.decoder, model.decoder))
        if is_parametrized(own, "weight"):
            own.weight = learnt.weight.detach()  # weight norm takes it apart
        else:
            own.weight.copy_(learnt.weight)
        own.bias.copy_(learnt.bias)
    training.codes.copy_(model.codes_of(names))


def train(
    samples: Samples,
    training: Training,
    config: TrainConfig,
    distillation: Distillation | None = None,
    processes: Processes = ALONE,
) -> Iterator[TrainingStep]:
    """Trains in place and yields after every step, from wherever `training` is to the last one.

    The loss of `distillation` has the weight `config.keep`. A step's random draw depends on the seed and the step
    alone, so a run that was stopped and resumed ends with the same weights. Each of several processes trains its part
    of the codes, and the decoder is the same in all.
    """
    device = training.codes.device
    step = partial(_step, training, config, distillation, processes, min(config.shapes_per_step, len(samples.names)))
    training.decoder.train()
    _prepare(training.optimiser, device)
    if device.type == "cuda" and processes.size == 1:  # the share of one process among several varies in size
        step = GraphedStep(step)
    while training.step < config.steps:
        began = time.perf_counter()
        _set_rates(training, config)
        torch.manual_seed((config.seed << 32) + training.step)
        shapes, rows = samples.draw(config.shapes_per_step, config.samples_per_step, config.variant_weight)
        between = () if distillation is None else (distillation.drawn(shapes),)
        own = processes.own(shapes)
        batch = samples.at(rows[:, own]).to(device)
        own_codes = (shapes[own] // processes.size).to(device)
        loss = step(own_codes, batch, *(codes[own] for codes in between)).item()
        record(training.losses, training.step, loss)
        training.step += 1
        yield TrainingStep(training.step, loss, time.perf_counter() - began)


def _step(
    training: Training,
    config: TrainConfig,
    distillation: Distillation | None,
    processes: Processes,
    drawn: int,
    shapes: Tensor,
    batch: Float[Tensor, "shapes n 4"],
    between: Float[Tensor, "shapes length"] | None = None,
) -> Tensor:
    """One optimiser step; returns the samples' loss. `shapes` are those of this process, among `drawn` in all."""
    training.optimiser.zero_grad()
    if len(shapes):
        share = len(shapes) / drawn
        loss, rest = _losses(training, config, distillation, shapes, batch, between)
        (share * (loss + rest)).backward()
        loss = share * loss.detach()
    else:
        training.codes.grad = torch.zeros_like(training.codes)  # Adam's moments of undrawn codes decay
        loss = torch.zeros((), device=batch.device)
    loss = processes.add_up(list(training.decoder.parameters()), loss)
    training.optimiser.step()
    bound_codes(training.codes, config.code_bound)
    return loss


def _losses(
    training: Training,
    config: TrainConfig,
    distillation: Distillation | None,
    shapes: Tensor,
    batch: Float[Tensor, "shapes n 4"],
    between: Float[Tensor, "shapes length"] | None,
) -> tuple[Tensor, Tensor]:
    """The samples' loss, and the regularisers. Half of the points serve the distillation at codes `between`."""
    codes = training.codes.index_select(0, shapes)
    rest = config.code_penalty * codes.square().sum(-1).mean()
    with torch.autocast(batch.device.type, torch.bfloat16, enabled=config.bfloat16, cache_enabled=False):
        values = training.decoder(batch[..., :3], codes[:, None])
        if distillation is not None and between is not None:
            points = batch[:, ::2, :3]
            now = training.decoder(points, between[:, None])
            before = distillation.values(points, between)
            rest = rest + config.keep * clamped_loss(now.float(), before.float(), config.clamp)
    return training_loss(values.float(), batch[..., 3], config), rest


def _prepare(optimiser: torch.optim.Adam, device: torch.device) -> None:
    """Sets Adam's `capturable` flag and tensor learning rates on a GPU, as CUDA graphs need; else resets them."""
    graphed = device.type == "cuda"
    for group in optimiser.param_groups:
        group["capturable"] = graphed
        group["lr"] = torch.zeros((), device=device) if graphed else 0.0


def _set_rates(training: Training, config: TrainConfig) -> None:
    """Sets the step's learning rates: a trapezium, which can be prolonged (Hägele et al., NeurIPS 2024)."""
    left = (config.steps - training.step) / (config.steps * config.cool_down)
    share = min(1.0, (training.step + 1) / config.warm_up, left)
    rates = (share * config.learning_rate, share * config.code_learning_rate)
    for group, rate in zip(training.optimiser.param_groups, rates, strict=True):
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)  # a CUDA graph reads it from this address
        else:
            group["lr"] = rate


@torch.no_grad()
def bound_codes(codes: Tensor, bound: float) -> None:
    """Scales codes that are longer than the bound back to it."""
    codes.mul_((bound / codes.norm(dim=-1, keepdim=True).clamp_min(1e-12)).clamp_max(1.0))


def faster_in_bfloat16(specs: NetworkSpecs, device: torch.device) -> bool:
    """Whether this machine trains faster with bfloat16 products: some processors emulate them, and old GPUs."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)  # a few steps are over too soon to tell
    seconds = {}
    for bfloat16 in (False, True, False, True):  # the second time of each counts
        config = TrainConfig(steps=2, bfloat16=bfloat16)
        random = Side.of([torch.rand(4096, 4) * 0.1])
        run = train(Samples(["random"], random, random).to(device), start_training(1, specs, config, device), config)
        seconds[bfloat16] = min(step.seconds for step in run)
    return seconds[True] < seconds[False]
