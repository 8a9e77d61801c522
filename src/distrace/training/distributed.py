"""Training in several processes that `torchrun` starts: each owns a part of the shapes, and their codes.

Shape s belongs to process s modulo their number. All processes draw the same batch, evaluate the rows of their own
shapes, and add up the gradients of the decoder. DistributedDataParallel does not fit: it averages gradients of equal
shares, but here shares differ from step to step and can be empty. A single process pays nothing.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from jaxtyping import Float, Int
from torch import Tensor, nn

TIMEOUT = timedelta(hours=12)  # samples may be converted for hours; torchrun ends the others where a process fails
Value = TypeVar("Value")


@dataclass(frozen=True)
class Processes:
    """All processes of a run, as the one of number `rank` sees them."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Returns whether this process prints, and writes the files."""
        return self.rank == 0

    def own(self, shapes: Int[Tensor, "drawn"]) -> Int[Tensor, "own"] | slice:
        """Returns the places of this process's shapes among those drawn."""
        return slice(None) if self.size == 1 else (shapes % self.size == self.rank).nonzero()[:, 0]

    def part(self, rows: Float[Tensor, "shapes _"]) -> Float[Tensor, "own _"]:
        """Returns the rows of this process's shapes; that of shape s has the number s // size."""
        return rows[self.rank :: self.size].clone()

    def gathered(self, own: Float[Tensor, "own n"], shapes: int) -> Float[Tensor, "shapes n"]:
        """Returns the rows of all shapes, in their order, from the rows that each process gives."""
        padded = own.new_zeros(-(-shapes // self.size), own.shape[1])
        padded[: len(own)] = own
        parts = [torch.empty_like(padded) for _ in range(self.size)]
        dist.all_gather(parts, padded)
        return torch.stack(parts, dim=1).flatten(0, 1)[:shapes]

    def add_up(self, parameters: Sequence[nn.Parameter], loss: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Returns the sum of the processes' losses; each gradient becomes the sum of theirs, and none counts as 0."""
        if self.size == 1:
            return loss
        gradients = [torch.zeros_like(each) if each.grad is None else each.grad for each in parameters]
        total = torch.cat([loss.reshape(1), *(gradient.flatten() for gradient in gradients)])
        dist.all_reduce(total)
        summed = total[1:].split([gradient.numel() for gradient in gradients])
        for parameter, gradient in zip(parameters, summed, strict=True):
            parameter.grad = gradient.view_as(parameter)
        return total[0]

    def from_leader(self, make: Callable[[], Value]) -> Value:
        """Returns in every process what `make` returns in the leader; the others do not call it.

        Where it raises, the leader raises that, and the others end: one sentence on the screen is enough.
        """
        if self.size == 1:
            return make()
        error = None
        values: list[Any] = [None, False]
        if self.leads:
            try:
                values = [make(), False]
            except Exception as caught:
                error = caught
                values = [None, True]
        dist.broadcast_object_list(values)
        if error is not None:
            raise error
        if values[1]:
            sys.exit(2)
        return values[0]

    def wait(self) -> None:
        """Returns once every process has come to this place."""
        if self.size > 1:
            dist.barrier()


ALONE = Processes()


@contextmanager
def joined(device: torch.device) -> Iterator[tuple[Processes, torch.device]]:
    """Joins the processes that torchrun started, if it did; yields them and this one's device."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield ALONE, device
        return
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=TIMEOUT)
    try:
        yield Processes(int(os.environ["RANK"]), size), device
    finally:
        dist.destroy_process_group()
