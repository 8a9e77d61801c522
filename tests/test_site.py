"""The site of documentation: its reference is complete, and its pages load nothing from other hosts."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

import distrace as dt

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


class Loaded(HTMLParser):
    """The addresses that a page loads as it is opened."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "link" and given.get("rel") in ("canonical", "next", "prev"):
            return
        if tag in ("link", "script", "img", "iframe", "source", "video"):
            self.found += [value for key in ("src", "href") if (value := given.get(key))]


def test_the_reference_has_every_public_name_once() -> None:
    pages = [page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md")]
    names = [name for page in pages for name in re.findall(r"^::: distrace\.public\.(\w+)$", page, re.MULTILINE)]
    assert sorted(names) == sorted(dt.__all__)


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    pages = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert pages <= set(re.findall(r"[\w/]+\.md", navigation))


def test_every_example_and_every_extra_is_explained() -> None:
    examples = (DOCS / "examples.md").read_text(encoding="utf-8")
    assert all(f"../examples/{path.name})" in examples for path in (ROOT / "examples").glob("*.py"))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("[project.optional-dependencies]\n")[2]
    extras = re.findall(r"^(\w+) = \[", project.partition("\n[")[0], re.MULTILINE)
    assert "report" in extras
    install = (DOCS / "install.md").read_text(encoding="utf-8")
    assert all(f"| `{extra}` |" in install for extra in extras)


@pytest.mark.slow
def test_the_site_is_built_without_warnings_and_loads_nothing_from_other_hosts(tmp_path: Path) -> None:
    pytest.importorskip("material")
    pytest.importorskip("mkdocstrings")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path), strict=True))
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > len(list(DOCS.rglob("*.md")))
    for page in pages:
        parser = Loaded()
        parser.feed(page.read_text(encoding="utf-8"))
        assert parser.found
        assert not [address for address in parser.found if re.match(r"(https?:)?//", address)], page
    assert not re.findall(
        r"@import|url\(['\"]?https?:", "".join(sheet.read_text() for sheet in tmp_path.rglob("*.css"))
    )
