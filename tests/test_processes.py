"""Work in several processes, and how it ends."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from distrace.processes import parallel_map


def begun(folder: Path, number: int) -> int:
    """Leaves the number of its process, and takes as many seconds as its own number says."""
    (folder / str(number)).write_text(str(os.getpid()))
    time.sleep(number)
    return number


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def waited_for(path: Path) -> None:
    patience = time.monotonic() + 120
    while not path.exists() or not path.read_text():
        assert time.monotonic() < patience
        time.sleep(0.05)


def test_results_come_as_they_are_done_and_what_is_left_ends_with_the_caller(tmp_path: Path) -> None:
    results = parallel_map(partial(begun, tmp_path), [300, 0], jobs=2)
    assert next(results) == 0
    waited_for(tmp_path / "300")
    began, process = time.monotonic(), int((tmp_path / "300").read_text())
    results.close()
    assert time.monotonic() - began < 60
    assert not alive(process)


PROGRAM = (
    "from functools import partial; from pathlib import Path; from test_processes import begun\n"
    "from distrace.processes import parallel_map\n"
    "if __name__ == '__main__':\n"
    "    import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # shells have jobs ignore it
    "    try: list(parallel_map(partial(begun, Path(r'{folder}')), [300], 1))\n"
    "    except KeyboardInterrupt: print('stopped')\n"
)


def at_work(folder: Path) -> subprocess.Popen:
    """A process that has begun another, which is at work."""
    script = folder / "work.py"
    script.write_text(PROGRAM.format(folder=folder))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    pipe, words = subprocess.PIPE, [sys.executable, script]
    process = subprocess.Popen(words, stdout=pipe, stderr=pipe, env=environment, start_new_session=True, text=True)
    waited_for(folder / "300")
    return process


@pytest.mark.skipif(sys.platform == "win32", reason="its consoles have no process groups")
def test_ctrl_c_reaches_all_processes_and_only_the_first_speaks(tmp_path: Path) -> None:
    process = at_work(tmp_path)
    os.killpg(process.pid, signal.SIGINT)
    said, complained = process.communicate(timeout=60)
    assert (said.strip(), complained.strip()) == ("stopped", "")


def test_processes_end_with_a_caller_that_is_killed(tmp_path: Path) -> None:
    process = at_work(tmp_path)
    process.kill()
    process.wait()
    patience = time.monotonic() + 60
    while alive(int((tmp_path / "300").read_text())):
        assert time.monotonic() < patience
        time.sleep(0.05)
