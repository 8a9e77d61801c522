"""How the package and the command line start: quickly, and without the libraries that are not used yet."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest

import distrace
import distrace.public
from distrace.cli import COMMANDS, Lazy
from distrace.imports import quickly

HEAVY = {
    *("trimesh", "scipy", "skimage", "PIL", "matplotlib", "plotly"),
    *("igl", "embreex", "manifold3d", "pycolmap", "av", "torch._dynamo"),
}
WAITED = "import os, distrace; print(os.environ['GOMP_SPINCOUNT'])"
NOTHING = "import distrace"
EVERYTHING = "from distrace.cli import COMMANDS; [each.loaded() for each in COMMANDS.values()]"
LISTENING = """
import gc
before = gc.isenabled()
passes = []
gc.callbacks.append(lambda phase, details: passes.append(details["generation"]))
import distrace
distrace.Camera
gc.callbacks.clear()
print(before == gc.isenabled(), 2 in passes)
"""
HELP = """
import sys
from distrace.cli import main
sys.argv = ["distrace", "--help"]
try:
    main()
except SystemExit:
    pass
"""


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)


def printed(program: str) -> list[str]:
    """The lines that a program prints; the last has the modules that it loads, in their order."""
    done = python("-c", f"{program}\nimport sys\nprint(*sys.modules)")
    assert done.returncode == 0, done.stderr[-500:]
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def everything() -> list[str]:
    """What is printed where all public names, then all commands are loaded."""
    return printed(LISTENING + EVERYTHING)


@pytest.fixture(scope="module")
def modules(everything: list[str]) -> list[str]:
    return everything[-1].split()


def test_public_names_are_imported_without_garbage_collection(everything: list[str]) -> None:
    assert everything[0] == "True False"


def test_garbage_collection_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        assert quickly("distrace.public") is distrace.public
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_threads_are_set_before_torch_reads_how_long_they_spin(modules: list[str]) -> None:
    assert modules.index("distrace.threads") < modules.index("torch._C")


def test_neither_public_names_nor_commands_load_heavy_libraries(modules: list[str]) -> None:
    assert {"distrace.cli.reconstruct", "distrace.cli.train", "distrace.report.scene"} <= set(modules)
    assert (HEAVY | {"distrace.notebook"}) & set(modules) == set()


@pytest.mark.parametrize("program", [NOTHING, HELP])
def test_importing_the_package_or_asking_for_help_loads_no_torch(program: str) -> None:
    modules = set(printed(program)[-1].split())
    assert "distrace" in modules
    assert (HEAVY | {"torch", "numpy"}) & modules == set()


def test_public_names_are_attributes_of_the_package_and_render_is_the_function() -> None:
    assert distrace.__all__ == distrace.public.__all__
    assert set(distrace.__all__) == set(dir(distrace))
    assert all(getattr(distrace, name) is getattr(distrace.public, name) for name in distrace.__all__)
    assert callable(distrace.render)
    assert distrace.fields.base.SDF is distrace.SDF
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        getattr(distrace, "nothing")  # noqa: B009


@pytest.mark.parametrize("name", COMMANDS)
def test_a_summary_is_the_first_sentence_of_the_command(name: str) -> None:
    command = COMMANDS[name]
    assert isinstance(command, Lazy)
    assert (command.loaded().__doc__ or "").split("\n")[0] == command.summary


def test_what_the_user_said_stays() -> None:
    assert python("-c", WAITED, GOMP_SPINCOUNT="7").stdout.strip() == "7"


def test_it_says_its_version() -> None:
    assert python("-m", "distrace", "--version").stdout == f"distrace {distrace.__version__}\n"


def test_help_is_printed_in_any_encoding() -> None:
    done = python("-m", "distrace", "--help", PYTHONIOENCODING="ascii")
    assert done.returncode == 0
    assert "check-gradients" in done.stdout


def test_ctrl_c_while_modules_are_imported_is_one_line(tmp_path: Path) -> None:
    interrupting = "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(20)"
    (tmp_path / "torch.py").write_text(interrupting)
    path = os.pathsep.join([str(tmp_path), str(Path(distrace.__file__).parents[1])])
    # A shell has its background jobs ignore interrupts.
    attended = "import signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    program = attended + "from distrace.cli import main; sys.argv = ['distrace', 'mesh', 'sofas']; main()"
    done = python("-c", program, PYTHONPATH=path)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "distrace: interrupted\n")


def test_help_into_a_closed_pipe_is_quiet() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "distrace", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout
    process.stdout.close()
    assert process.stderr
    assert process.stderr.read() == ""
    assert process.wait() == 0
