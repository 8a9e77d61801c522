"""Files are whole or absent, whatever lay there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from distrace.files import atomic_write, save_text


def dead_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_an_unfinished_file_leaves_the_one_that_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a"
    save_text(path, "whole")
    with pytest.raises(ZeroDivisionError), atomic_write(path) as file:
        file.write(bytes(1 // 0))
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("a", "whole")]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no signal that only asks whether a process runs")
def test_parts_of_dead_processes_are_removed_when_the_file_is_written(tmp_path: Path) -> None:
    mine, other = f".a[1].txt.{os.getppid()}.part", f".b.{dead_process()}.part"
    for name in (f".a[1].txt.{dead_process()}.part", mine, other, ".a[1].txt.x.part"):
        (tmp_path / name).write_text("half")
    save_text(tmp_path / "a[1].txt", "whole")
    assert {path.name for path in tmp_path.iterdir()} == {"a[1].txt", mine, other, ".a[1].txt.x.part"}


def test_a_symbolic_link_is_replaced_not_followed(tmp_path: Path) -> None:
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    save_text(tmp_path / "link", "new")
    assert not (tmp_path / "link").is_symlink()
    assert (tmp_path / "link").read_text() == "new"
    assert (tmp_path / "target").read_text() == "old"
