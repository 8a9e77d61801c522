"""Errors that end in one sentence, whatever a library raised underneath."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def explained(sentence: str) -> Iterator[None]:
    """Anything that goes wrong inside is raised again as `ValueError(sentence)`; Ctrl-C passes through."""
    try:
        yield
    except Exception as error:
        cause = str(error).strip().splitlines()
        raise ValueError(f"{sentence} ({cause[0]})" if cause else sentence) from error
