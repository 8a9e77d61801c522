"""Without a library that only a part needs, that part says how to install it, and the rest works."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from distrace import shading
from distrace.cli.console import Run
from distrace.data.photo_readers import colmap
from distrace.data.solid import first_met, outer_surface
from distrace.movie import save_mp4
from distrace.optional import EXTRAS, MissingLibrary, require
from distrace.report.charts import curves, plot_history
from distrace.report.scene import scene

BALL = trimesh.creation.icosphere(1)
PICTURES = np.zeros((2, 4, 4, 3), np.uint8)


def read_colmap(folder: Path) -> None:
    (folder / "cameras.txt").write_text("")
    colmap.read(folder)


USES: list[tuple[str, Callable[[Path], object]]] = [
    ("igl", lambda folder: outer_surface(BALL)),
    ("embreex", lambda folder: first_met(BALL, np.zeros((1, 3)), np.ones((1, 3)))),
    ("pycolmap", read_colmap),
    ("av", lambda folder: save_mp4(folder / "a.mp4", PICTURES)),
    ("plotly", lambda folder: scene({}, {})),
    ("matplotlib", lambda folder: curves({}, "x", "y", False)),
    ("matplotlib", lambda folder: plot_history(folder / "a.png", [1.0], 1, "x", "y")),
]


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Makes a library one that is not installed."""

    def block(library: str) -> None:
        for name in [name for name in sys.modules if name == library or name.startswith(f"{library}.")]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, library, None)

    return block


@pytest.mark.parametrize(("library", "use"), USES)
def test_a_missing_library_is_one_sentence_that_says_how_to_install_it(
    library: str, use: Callable[[Path], object], without: Callable[[str], None], tmp_path: Path
) -> None:
    without(library)
    expected = rf"^[^\n.]+ needs {library}; install it by pip install 'distrace\[{EXTRAS[library]}\]'$"
    with pytest.raises(MissingLibrary, match=expected):
        use(tmp_path)
    assert [path for path in tmp_path.iterdir() if path.suffix in (".mp4", ".png", ".part")] == []


def test_a_command_that_needs_it_says_so_and_ends(
    without: Callable[[str], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    from distrace.cli import main

    without("av")
    monkeypatch.setattr(sys, "argv", ["distrace", "render", "sofas", "--orbit", "3", "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert capsys.readouterr().err == "distrace: --orbit needs av; install it by pip install 'distrace[movie]'\n"


def test_a_page_without_its_library_is_left_out_with_one_warning(
    capsys: pytest.CaptureFixture, tmp_path: Path, without: Callable[[str], None]
) -> None:
    without("plotly")
    run = Run(tmp_path, torch.device("cpu"))
    for _ in range(2):
        with run.optional("report.html"):
            scene({}, {})
    sentence = "report.html is left out: a 3-D view needs plotly; install it by pip install 'distrace[report]'"
    assert run.warnings == [sentence]
    assert capsys.readouterr().err == f"distrace: warning: {sentence}\n"


def test_a_broken_library_is_not_taken_for_a_missing_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "av.py").write_text("import no_such_module")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "av", raising=False)
    with pytest.raises(ModuleNotFoundError, match="no_such_module") as caught:
        require("a movie", "av")
    assert not isinstance(caught.value, MissingLibrary)


def test_pictures_have_the_colours_of_matplotlib() -> None:
    from matplotlib import colormaps

    values = np.linspace(-0.1, 1.1, 1000)[None]
    for name in shading.COLOUR_MAPS:
        expected = np.rint(255 * colormaps[name](values)[..., :3])
        assert (np.rint(255 * shading._mapped(name, values)) == expected).all()


def test_every_library_belongs_to_an_extra_of_the_package() -> None:
    tomllib = pytest.importorskip("tomllib")
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    packages = {"igl": "libigl"}
    for library, extra in EXTRAS.items():
        requirements = project["optional-dependencies"][extra]
        assert any(each.startswith(packages.get(library, library)) for each in requirements), library
    assert set(EXTRAS.values()) == {*project["optional-dependencies"]} - {"all", "dev", "clips", "docs"}


def test_a_library_without_a_wheel_for_this_machine_is_to_be_built(
    without: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    without("embreex")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(MissingLibrary, match=r"^casting needs embreex; it has no wheel for Linux on aarch64"):
        require("casting", "embreex")
