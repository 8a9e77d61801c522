"""Settings of torch's threads: how long they spin before they sleep, and what they do with denormal numbers.

This module is imported before torch, whose OpenMP library reads the first when it loads. A script that imports torch
before distrace sets `GOMP_SPINCOUNT=20000` in its environment.

GNU's default, 300,000 rounds, suits threads that have a core each. On busy cores, spinning threads block the ones they
wait for: a view took 10.6 s instead of 6.4 s on two cores, the demo 300 s instead of 80 s. On idle cores 20,000 rounds
cost nothing measurable; 2,000 cost 10 %.
"""

import os
from collections.abc import Generator
from contextlib import contextmanager

os.environ.setdefault("GOMP_SPINCOUNT", "20000")


@contextmanager
def flushed_denormals() -> Generator[None, None, None]:
    """Denormal numbers count as zero inside. Adam's averages decay into them: training was 2.3 times slower."""
    import torch

    before = bool(torch.tensor(1e-40) == 0)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
