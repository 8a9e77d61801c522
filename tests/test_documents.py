"""Examples and the README's code run, and documents name only files that exist."""

import re
import sys
from pathlib import Path

import pytest
import torch
import trimesh

from distrace.checkpoints.model import load_model, save_experiment

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SLOW = ("06", "08", "10")
DOCUMENTS = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "results/README.md", "experiments/README.md")),
]
TUTORIALS = [
    *sorted((ROOT / "docs" / "tutorials").glob("*.md")),
    *(ROOT / "docs" / name for name in ("index.md", "install.md")),
]
CODE = re.compile(r"```python\n(.*?)```", re.DOTALL)


def run_small(code: str, arguments: tuple[object, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs code at 48 × 48 pixels."""
    monkeypatch.setattr(sys, "argv", ["example", *map(str, arguments)])
    dtype = torch.get_default_dtype()
    try:
        exec(compile(re.sub(r"height=\d+, width=\d+", "height=48, width=48", code), "example", "exec"), {})
    finally:
        torch.set_default_dtype(dtype)


def test_examples_are_numbered_and_short() -> None:
    assert [int(path.name[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))
    assert all(len(path.read_text(encoding="utf-8").splitlines()) <= 40 for path in EXAMPLES)


@pytest.fixture
def arguments(tmp_path: Path) -> dict[str, tuple[object, ...]]:
    """What each example is given."""
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "ball.ply")
    header = "name,split,design,turn,path,creator,licence,note"
    (tmp_path / "balls.csv").write_text(f"{header}\nball,test,ball,0,ball.ply,me,CC0-1.0,\n")
    sofas = load_model("sofas")
    save_experiment(tmp_path / "models" / "sofas", sofas.decoder, sofas.codes[:2], ("first", "second"))
    (tmp_path / "models" / "wrong").mkdir()
    (tmp_path / "models" / "wrong" / "specs.json").write_text("{}")
    return {
        "02": ("sofas", tmp_path / "out.png"),
        "03": (tmp_path / "balls.csv", "ball", tmp_path, tmp_path / "out"),
        "04": (tmp_path / "models", tmp_path / "out.png"),
        "05": (tmp_path / "models" / "sofas", tmp_path / "out"),
    }


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=[pytest.mark.slow] * (path.name[:2] in SLOW)) for path in EXAMPLES],
    ids=lambda path: path.stem,
)
def test_an_example_runs(
    path: Path, tmp_path: Path, arguments: dict[str, tuple[object, ...]], monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    if "browser" in path.stem:
        pytest.importorskip("viser")
    given = arguments.get(path.name[:2], ())
    monkeypatch.chdir(tmp_path)
    run_small(path.read_text(encoding="utf-8"), given, monkeypatch)
    printed = capsys.readouterr().out
    assert printed or Path(str(given[-1])).exists()
    if path.name.startswith("01"):
        derivative, difference = map(float, re.findall(r"-?\d\.\d+(?:e-?\d+)?", printed.splitlines()[-1]))
        assert derivative == pytest.approx(difference, rel=0.05)


def test_the_readmes_code_runs(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    (code,) = CODE.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    run_small(code, (), monkeypatch)
    assert re.fullmatch(r"\d+ pixels, \d+ evaluations, \|dL/dcode\| \d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("document", "code"),
    [(path.stem, code) for path in TUTORIALS for code in CODE.findall(path.read_text(encoding="utf-8"))],
)
def test_the_code_of_a_tutorial_runs(document: str, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run_small(code, (), monkeypatch)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_and_paths_of_documents_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = target.partition("#")
        if target.startswith("https:"):
            continue
        file = document if not path else document.parent / path
        assert file.exists(), target
        if anchor:
            headings = {heading_anchor(line) for line in file.read_text(encoding="utf-8").splitlines()}
            assert anchor in headings, target
    folders = (ROOT, ROOT / "src" / "distrace", ROOT / "experiments")
    for path in re.findall(r"`((?:[\w-]+/)+[\w-]+\.py|results/[\w-]+\.\w+)`", text):
        assert any((folder / path).exists() for folder in folders), path


def heading_anchor(line: str) -> str:
    """The anchor that GitHub gives to a heading."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line)  # of a link its words
    return re.sub(r"[^\w -]", "", text.lstrip("#").strip().lower()).replace(" ", "-")
