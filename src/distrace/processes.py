"""Tasks in parallel processes."""

import os
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from threading import Thread, current_thread, main_thread
from typing import TypeVar

import torch

Task = TypeVar("Task")
Result = TypeVar("Result")


def parallel_map(work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int) -> Iterator[Result]:
    """Yields the result of each task as it completes, from `jobs` processes of one thread each.

    If the caller stops, by Ctrl-C or otherwise, the processes are terminated: their files must be whole or absent.
    """
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_begin)
    with _deaf_children():
        pending = [pool.submit(work, task) for task in tasks]
    workers = list((pool._processes or {}).values())  # a public way to end them comes with Python 3.14
    try:
        for done in as_completed(pending):
            yield done.result()
    except BaseException:
        for worker in workers:
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """Sets up a process: one thread for the work, and one that waits for the parent's end."""
    torch.set_num_threads(1)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exits with the parent: if that is killed, its processes would wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _deaf_children() -> Generator[None, None, None]:
    """Starts processes that ignore Ctrl-C, which a terminal sends to all of them: the parent handles it."""
    if current_thread() is not main_thread():  # only the main thread may set signal handlers
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
