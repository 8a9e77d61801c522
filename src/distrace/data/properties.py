"""Java properties files, in which catalogues of furniture are written."""

import re
from collections.abc import Iterator


def properties(content: bytes) -> dict[str, str]:
    """The entries of a Java properties file, as java.util.Properties.load reads them."""
    pairs = (re.match(r"((?:\\.|[^\\=:\s])*)\s*[=:]?\s*(.*)", line, re.DOTALL) for line in _lines(content))
    return {_unescaped(pair[1]): _unescaped(pair[2]) for pair in pairs if pair}


def _lines(content: bytes) -> Iterator[str]:
    """Logical lines: comments and blanks dropped, those that end in a backslash joined to the next."""
    logical = ""
    for line in content.splitlines():
        text = line.decode("latin-1").lstrip(" \t\f")
        if not logical and text[:1] in ("", "#", "!"):
            continue
        logical += text
        if (len(logical) - len(logical.rstrip("\\"))) % 2:
            logical = logical[:-1]
        else:
            yield logical
            logical = ""
    if logical:
        yield logical


def _unescaped(text: str) -> str:
    controls = {"t": "\t", "n": "\n", "r": "\r", "f": "\f"}
    units = re.sub(
        r"\\(u[0-9a-fA-F]{4}|.)",
        lambda found: chr(int(found[1][1:], 16)) if len(found[1]) > 1 else controls.get(found[1], found[1]),
        text,
    )
    # Java writes characters beyond 16 bits as two \u escapes: a surrogate pair, which Python would keep apart.
    return units.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
