"""What `import distrace` and `python -m distrace` bring with them: threads that let others run, and nothing slow."""

import os
import subprocess
import sys

import pytest

WAITED = "import os, distrace; print(os.environ['GOMP_SPINCOUNT'])"


@pytest.fixture(scope="module")
def loaded() -> list[str]:
    """The modules that starting the command line loads, in their order."""
    command = [sys.executable, "-X", "importtime", "-m", "distrace", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "usage: distrace" in done.stdout
    return [line.rsplit("|")[-1].strip() for line in done.stderr.splitlines()]


def test_how_long_threads_spin_is_said_before_torch_reads_it(loaded: list[str]) -> None:
    assert loaded.index("distrace.threads") < loaded.index("torch._C")


def test_no_compiler_is_loaded(loaded: list[str]) -> None:
    assert "distrace.cli" in loaded
    assert "torch._dynamo" not in loaded, "a third of the time that a command takes to start"


def test_what_the_user_said_stays() -> None:
    environment = os.environ | {"GOMP_SPINCOUNT": "7"}
    said = subprocess.run([sys.executable, "-c", WAITED], capture_output=True, text=True, check=True, env=environment)
    assert said.stdout.strip() == "7"
