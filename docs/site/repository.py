"""Hooks of mkdocs: what documents link to in the repository becomes part of the site, and some of it is included.

A link to a file outside docs/ leads to a page of that file. A line `[…](FILE) <!-- included -->` is replaced by the
code of an example, or by the section of a document that its anchor names.
"""

import re
from pathlib import Path
from posixpath import dirname, join, normpath, relpath
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
HOMES = {"README.md": "index.md", "examples": "examples.md"}  # pages that stand for what documents link to
LINK = re.compile(r"\]\(([^)\s#:]+)(#[^)\s]*)?\)")
INCLUDED = re.compile(r"^\[[^\]]*\]\(([^)\s#]+)#?([^)\s]*)\) <!-- included -->$", re.MULTILINE)


def page_of(path: str) -> str:
    """Returns where a file of the repository is in the site's sources."""
    if path in HOMES:
        return HOMES[path]
    page = path.removeprefix("docs/")
    return f"{page}.md" if page.endswith(".py") else page


def on_files(files: Files, config: Any) -> Files:
    """Adds the files that documents link to, and those that these link to."""
    read = set()
    pending = [f"docs/{file.src_uri}" for file in files.documentation_pages()]
    while pending:
        path = pending.pop()
        read.add(path)
        for target, _ in LINK.findall((ROOT / path).read_text(encoding="utf-8")):
            linked = normpath(join(dirname(path), target))
            if linked in read or not (ROOT / linked).is_file():
                continue
            if files.get_file_from_path(page_of(linked)) is None:
                files.append(_file(linked, config))
            if linked.endswith(".md"):
                pending.append(linked)
    return files


def _file(path: str, config: Any) -> File:
    if path.endswith(".py"):
        code = (ROOT / path).read_text(encoding="utf-8")
        return File.generated(config, page_of(path), content=f"# {path}\n\n```python\n{code}```\n")
    return File.generated(config, page_of(path), abs_src_path=str(ROOT / path))


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Includes what is to be included, and makes links those of the site."""
    here = page.file.src_uri
    if here.endswith(".py.md"):
        return markdown
    path = here if not (ROOT / "docs" / here).exists() else f"docs/{here}"

    def included(match: re.Match[str]) -> str:
        source = normpath(join(dirname(path), match[1]))
        text = (ROOT / source).read_text(encoding="utf-8")
        if source.endswith(".py"):
            return f"```python\n{text}```"
        return _relinked(_section(text, match[2]), source, here)

    parts = []
    end = 0
    for match in INCLUDED.finditer(markdown):
        parts += [_relinked(markdown[end : match.start()], path, here), included(match)]
        end = match.end()
    return "".join([*parts, _relinked(markdown[end:], path, here)])


def _relinked(markdown: str, path: str, here: str) -> str:
    """Returns text of a file with its links as seen from a page."""

    def relinked(match: re.Match[str]) -> str:
        linked = normpath(join(dirname(path), match[1]))
        if not (ROOT / linked).exists():
            return match[0]
        return f"]({relpath(page_of(linked), dirname(here))}{match[2] or ''})"

    return LINK.sub(relinked, markdown)


def _section(markdown: str, anchor: str) -> str:
    """Returns the text between a heading and the next one. Raises `ValueError` without the heading."""
    taken = None
    fenced = False
    for line in markdown.splitlines():
        fenced ^= line.startswith("```")
        heading = line.startswith("#") and not fenced
        if heading and taken is not None:
            break
        if taken is not None:
            taken.append(line)
        elif heading and line.lstrip("# ").lower().replace(" ", "-") == anchor:
            taken = []
    if taken is None:
        raise ValueError(f"there is no section {anchor!r} to include")
    return "\n".join(taken).strip()
