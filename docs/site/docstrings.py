"""An extension of griffe: examples in docstrings become code, and comments beside fields describe them."""

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"^>>> .*(?:\n.+)*", re.MULTILINE)


class Docstrings(griffe.Extension):
    """Reads docstrings as this project writes them."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring is not None:
            value = re.sub(r" *# doctest: .*", "", obj.docstring.value)
            obj.docstring.value = EXAMPLE.sub(lambda match: f"```pycon\n{match[0]}\n```", value)
        elif obj.is_attribute and obj.parent is not None and obj.parent.is_class:
            _, _, comment = " ".join(obj.lines).partition("  # ")
            if comment:
                obj.docstring = griffe.Docstring(comment[:1].upper() + comment[1:] + ".", parent=obj)
