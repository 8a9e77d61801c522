"""Errors and warnings of one sentence, whatever a library raised underneath."""

import errno
import re
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from distrace.optional import MissingLibrary

NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


class DoubtfulResult(UserWarning):
    """Warns of a result that is probably not the one intended; its sentence says why.

    >>> import warnings
    >>> warnings.simplefilter("error", DoubtfulResult)  # makes it an exception
    >>> warnings.simplefilter("default", DoubtfulResult)
    """


@contextmanager
def error_context(sentence: str, file: Path | None = None) -> Generator[None, None, None]:
    """Raises any error inside again as `ValueError(sentence)`, with its cause.

    The cause is what lies in place of `file`, if that is a Git LFS pointer or a web page; else the error's first
    sentence. Ctrl-C, a full disk and a missing library pass through: no file that is read is to blame for them.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, MissingLibrary) or (isinstance(error, OSError) and error.errno in NO_SPACE):
            raise
        if file is not None and not file.exists():
            raise ValueError(f"{file} does not exist") from error
        cause = re.split(r"\.?\s*\n|\.\s", str(error).strip())[0]
        if isinstance(error, KeyError):
            cause = "no key " + cause.replace(" is not a file in the archive", "")  # as NumPy says it
        cause = (file and _stand_in(file)) or cause
        raise ValueError(f"{sentence} ({cause})" if cause else sentence) from error


@contextmanager
def about(subject: object) -> Generator[None, None, None]:
    """Raises a `ValueError` inside again, with its subject in front."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{subject}: {error}") from error


def _stand_in(file: Path) -> str:
    """What lies in place of a file that was not downloaded; empty if it is no such thing."""
    head = b""
    if file.is_file():
        with file.open("rb") as content:
            head = content.read(100).lstrip().lower()
    if head.startswith(b"version https://git-lfs"):
        return "it is a Git LFS pointer; `git lfs pull` fetches the file itself"
    return "it is a web page; download the file itself" if head.startswith((b"<!doctype html", b"<html")) else ""
