"""Errors and warnings of one sentence, whatever a library raised underneath."""

import re
from collections.abc import Iterator
from contextlib import contextmanager


class DoubtfulResult(UserWarning):
    """A result that was made, but that is probably not what was meant; one sentence says why."""


@contextmanager
def explained(sentence: str) -> Iterator[None]:
    """Anything that goes wrong inside is raised again as `ValueError(sentence)`; Ctrl-C passes through."""
    try:
        yield
    except Exception as error:
        cause = re.split(r"\.?\s*\n|\.\s", str(error).strip())[0]  # of a library's explanation, the first sentence
        cause = f"no key {cause}" if isinstance(error, KeyError) else cause
        raise ValueError(f"{sentence} ({cause})" if cause else sentence) from error


@contextmanager
def about(subject: object) -> Iterator[None]:
    """A `ValueError` inside is raised again with what it is about before it."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{subject}: {error}") from error
