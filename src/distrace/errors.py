"""Errors and warnings of one sentence, whatever a library raised underneath."""

import re
from collections.abc import Generator
from contextlib import contextmanager


class DoubtfulResult(UserWarning):
    """Warns of a result that is probably not the one intended; its sentence says why.

    >>> import warnings
    >>> warnings.simplefilter("error", DoubtfulResult)  # makes it an exception
    >>> warnings.simplefilter("default", DoubtfulResult)
    """


@contextmanager
def explained(sentence: str) -> Generator[None, None, None]:
    """Raises any error inside again as `ValueError(sentence)`; Ctrl-C passes through."""
    try:
        yield
    except Exception as error:
        cause = re.split(r"\.?\s*\n|\.\s", str(error).strip())[0]  # of a library's explanation, the first sentence
        cause = f"no key {cause}" if isinstance(error, KeyError) else cause
        raise ValueError(f"{sentence} ({cause})" if cause else sentence) from error


@contextmanager
def about(subject: object) -> Generator[None, None, None]:
    """Raises a `ValueError` inside again, with its subject in front."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{subject}: {error}") from error
