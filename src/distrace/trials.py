"""Experiments of many trials that do not depend on each other: in processes, going on where they were stopped."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import torch

from distrace.checkpoint import Model, load_model
from distrace.errors import explained

Trial = TypeVar("Trial")
Result = TypeVar("Result")


def each_done(work: Callable[[Trial], Result], wanted: Sequence[Trial], jobs: int) -> Iterator[Result]:
    """The result of each trial, as it is done; in so many processes of one thread each."""
    with ProcessPoolExecutor(
        jobs, mp_context=get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        pending = [pool.submit(work, trial) for trial in wanted]
        try:
            for done in as_completed(pending):
                yield done.result()
        finally:
            pool.shutdown(cancel_futures=True)


def grouped(results: Iterable[Result], key: Callable[[Result], tuple]) -> dict[tuple, list[Result]]:
    """Results of one key together, in the order in which the keys first come."""
    groups: dict[tuple, list[Result]] = {}
    for each in results:
        groups.setdefault(key(each), []).append(each)
    return groups


@cache
def opened_once(name: str) -> Model:
    """A model, read once by each process."""
    return load_model(name)


def read_json(path: Path) -> Any:
    """What a trial left. Raises `ValueError` for a file that is not JSON."""
    with explained(f"{path} holds no trials; remove it to begin anew"):
        return json.loads(path.read_text())
