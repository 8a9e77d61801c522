"""Tasks in parallel processes, of this machine or of a Ray cluster."""

import os
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context, parent_process
from socket import create_connection
from threading import Thread, current_thread, main_thread
from typing import Any, TypeVar

import torch

from distrace.optional import require

Task = TypeVar("Task")
Result = TypeVar("Result")


RETRIES = 3  # of a task whose machine of a cluster was lost
CONNECT_SECONDS = 5.0  # until a cluster must answer


def parallel_map(
    work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int, cluster: str | None = None
) -> Iterator[Result]:
    """Yields the result of each task as it completes, from `jobs` processes of one thread each.

    With the address of a Ray `cluster`, or `auto` for the one of this machine, its free cores do the tasks instead; one
    whose machine is lost is done again elsewhere. Its machines need distrace, and the same files under the same names.

    If the caller stops, by Ctrl-C or otherwise, the processes are terminated: their files must be whole or absent.
    """
    if cluster is not None:
        yield from _on_cluster(work, tasks, cluster)
        return
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


def _on_cluster(work: Callable[[Task], Result], tasks: Sequence[Task], address: str) -> Iterator[Result]:
    """Raises `ValueError` where there is no cluster, and `MissingLibrary` without Ray."""
    require("--cluster", "ray")
    ray: Any = import_module("ray")
    if not ray.is_initialized():
        try:
            if ":" in address and "//" not in address:  # Ray tries for minutes
                host, port = address.rsplit(":", 1)
                create_connection((host, int(port)), CONNECT_SECONDS).close()
            ray.init(address=address, log_to_driver=False, logging_level="error", configure_logging=False)
        except (OSError, RuntimeError, ValueError) as error:
            raise ValueError(
                f"--cluster {address} was given, and no Ray cluster answers there; `ray start --head` starts one"
            ) from error

    here = os.getcwd()

    def alone(task: Task) -> Result:
        torch.set_num_threads(1)
        os.chdir(here)  # relative paths mean the same files as here
        return work(task)

    remote = ray.remote(num_cpus=1, max_retries=RETRIES)(alone)
    pending = [remote.remote(task) for task in tasks]
    try:
        while pending:
            done, pending = ray.wait(pending)
            for result in done:
                yield ray.get(result)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None  # what the task raised, without the traceback of its machine
    except ray.exceptions.RayError as error:
        raise ValueError(
            f"the cluster at {address} lost a task {RETRIES + 1} times, or itself; see its logs"
        ) from error
    finally:
        for each in pending:
            ray.cancel(each, force=True)


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
