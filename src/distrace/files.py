"""Files that are whole or absent, never half written."""

import glob
import json
import os
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import safetensors.torch
import torch
from torch import Tensor


@contextmanager
def atomic_write(path: str | Path) -> Generator[BinaryIO, None, None]:
    """Opens a file to write; it gets the name `path` once all of it is on the disk.

    A symbolic link of that name is replaced, not followed. Parts that killed processes left of the file are removed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale_parts(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def run_lock(folder: str | Path) -> Generator[None, None, None]:
    """Locks a folder for this process. Raises `ValueError` if another one holds the lock."""
    from filelock import FileLock, Timeout

    try:
        lock = FileLock(Path(folder) / ".lock").acquire(blocking=False)
    except Timeout:
        raise ValueError(f"another run is writing {folder}; wait for its end, or give another --out") from None
    with lock:
        yield


def save_text(path: str | Path, text: str) -> None:
    """Writes a text in UTF-8."""
    with atomic_write(path) as file:
        file.write(text.encode())


def save_json(path: str | Path, content: Any) -> None:
    """Writes JSON; numbers of other types become floats."""
    save_text(path, json.dumps(content, indent=1, default=float) + "\n")


def save_arrays(path: str | Path, arrays: Mapping[str, Tensor], words: Mapping[str, str] = {}) -> None:
    """Writes tensors, and single words, as `.npz`."""
    content: dict[str, Any] = {name: array.detach().cpu().numpy() for name, array in arrays.items()}
    content |= {name: np.array(word) for name, word in words.items()}
    with atomic_write(path) as file:
        np.savez_compressed(file, **content)


def save_tensors(path: str | Path, tensors: Mapping[str, Tensor], dtype: torch.dtype = torch.float16) -> None:
    """Writes tensors as safetensors; those of floating-point numbers in half precision, or another type."""
    content: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        content[name] = (tensor.detach().to(dtype) if tensor.is_floating_point() else tensor).contiguous()
    with atomic_write(path) as file:
        file.write(safetensors.torch.save(content))


def emptied(folder: Path) -> Path:
    """Makes an empty folder, in place of the one that was there."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def file_in_the_way(folder: Path) -> Path | None:
    """Returns what is a file among a folder that is to be made and those above it, or None."""
    return next((path for path in (folder, *folder.parents) if path.exists() and not path.is_dir()), None)


def _remove_stale_parts(path: Path) -> None:
    for part in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        process = part.name.removeprefix(f".{path.name}.").removesuffix(".part")
        if process.isdecimal() and not _runs(int(process)):
            part.unlink(missing_ok=True)


def _runs(process: int) -> bool:
    """Returns whether a process may be running; on Windows the signal 0 would end it."""
    if os.name == "nt":
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
