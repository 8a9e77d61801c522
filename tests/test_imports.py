"""Imports go downward only, and only the command line and the viewer print."""

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "distrace"
ORDER = [
    *(
        "threads",
        "imports",
        "optional",
        "errors",
        "files",
        "processes",
        "equality",
        "image_cache",
        "pixels",
        "vectors",
        "colour_space",
    ),
    *("rays", "viewpoint", "camera", "pose"),
    *("fields", "surface", "shading", "notebook", "checkpoints", "prior"),
    *("tracing", "render", "boundary", "lights", "coloured", "antialiasing", "movie", "checking"),
    *("losses", "metrics", "mesh", "data"),
    *("training", "fitting", "photos", "reconstruction", "viewer", "public"),
    *("report", "benchmarks", "cli", "__main__"),
]
SHELL = set(ORDER[ORDER.index("report") :])
FILES = {path.relative_to(SOURCE).with_suffix("").as_posix(): path for path in SOURCE.rglob("*.py")}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in FILES.items()}
PARTS = sorted({name.split("/")[0] for name in TREES} - {"__init__"})


def imported(name: str) -> set[str]:
    """The parts of distrace that a module imports; a name of the package itself counts as `__init__`."""
    found: set[str] = set()
    folder = ["distrace", *name.split("/")[:-1]]
    for node in ast.walk(TREES[name]):
        paths: list[str] = []
        if isinstance(node, ast.Import):
            paths = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = folder[: len(folder) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            paths = [f"{base}.{alias.name}" for alias in node.names]
        inside = [path.split(".") for path in paths if path.split(".")[0] == "distrace"]
        found |= {part[1] if len(part) > 1 and part[1] in PARTS else "__init__" for part in inside}
    return found


def prints(name: str) -> bool:
    return any(isinstance(node, ast.Name) and node.id == "print" for node in ast.walk(TREES[name]))


@pytest.mark.parametrize("name", sorted(TREES))
def test_imports_go_downward_and_nothing_imports_the_shell(name: str) -> None:
    part = name.split("/")[0]
    if part == "__init__":
        assert not imported(name) & SHELL
        return
    assert part in ORDER, "a new module needs a place in the order"
    below = set(ORDER[: ORDER.index(part)]) | ({part} if "/" in name else set())
    allowed = below | {"__init__"} if part in SHELL else below - SHELL
    assert imported(name) <= allowed


def test_nothing_imports_the_experiments() -> None:
    modules = {name for tree in TREES.values() for node in ast.walk(tree) for name in modules_of(node)}
    assert "torch" in modules
    assert "experiments" not in modules


def modules_of(node: ast.AST) -> set[str]:
    """The top-level modules that a statement imports."""
    if isinstance(node, ast.Import):
        return {alias.name.split(".")[0] for alias in node.names}
    return {node.module.split(".")[0]} if isinstance(node, ast.ImportFrom) and node.module else set()


def test_only_the_command_line_prints_and_the_viewer_its_address() -> None:
    assert [name for name in TREES if prints(name) and not name.startswith("cli/")] == ["viewer/page"]
