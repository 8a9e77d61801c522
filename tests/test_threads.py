"""Threads that wait do not keep others from running."""

import os
import subprocess
import sys

WAITED = "import os, distrace; print(os.environ['GOMP_SPINCOUNT'])"


def test_how_long_threads_spin_is_said_before_torch_reads_it() -> None:
    command = [sys.executable, "-X", "importtime", "-c", "import distrace"]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True).stderr.splitlines()
    order = [line.rsplit("|")[-1].strip() for line in loaded]
    assert order.index("distrace.threads") < order.index("torch._C")


def test_what_the_user_said_stays() -> None:
    environment = os.environ | {"GOMP_SPINCOUNT": "7"}
    said = subprocess.run([sys.executable, "-c", WAITED], capture_output=True, text=True, check=True, env=environment)
    assert said.stdout.strip() == "7"
