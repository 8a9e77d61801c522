"""Many inputs of a folder are completed one by one, and none is lost or done twice."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from distrace.cli.complete import Complete
from distrace.cli.complete_folder import FolderJob, inputs_in


@dataclass(frozen=True)
class Counting:
    """A command that counts its runs in a file, and refuses what is empty."""

    out: Path
    path: Path
    seed: int = 0

    def run(self) -> None:
        self.out.mkdir(parents=True, exist_ok=True)
        with (self.out / "runs").open("a") as file:
            file.write("x")
        print("a line that is not shown")
        if not self.path.read_bytes():
            raise ValueError("it is empty")
        (self.out / "result.json").write_text('{"verdict": "trusted", "loss": 0.5, "other": 1}')


def job(folder: Path, content: str = "0 0 0", seed: int = 0) -> FolderJob:
    path = folder / "a.xyz"
    path.write_text(content)
    return FolderJob(path, Counting(folder / "out", path, seed))


def runs(folder: Path) -> int:
    return len((folder / "out" / "runs").read_text())


def test_a_row_has_the_result_and_is_not_computed_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    row = job(tmp_path).run()
    assert row == {"input": "a.xyz", "verdict": "trusted", "loss": 0.5}
    assert job(tmp_path).run() == row
    assert runs(tmp_path) == 1
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("other", [{"content": "1 1 1"}, {"seed": 1}])
def test_another_input_or_option_is_computed_anew(tmp_path: Path, other: dict) -> None:
    job(tmp_path).run()
    job(tmp_path, **other).run()
    assert runs(tmp_path) == 2


def test_another_model_is_computed_anew(tmp_path: Path) -> None:
    weights = tmp_path / "weights"
    for content in ("a", "b"):
        weights.write_text(content)
        first = job(tmp_path)
        FolderJob(first.path, first.command, (weights,)).run()
    assert runs(tmp_path) == 2


def test_a_refused_input_is_a_row(tmp_path: Path) -> None:
    refused = {"input": "a.xyz", "verdict": "refused", "reason": "it is empty"}
    assert job(tmp_path, "").run() == refused
    assert job(tmp_path, "").run() == refused
    assert runs(tmp_path) == 2, "it is tried again: a library may be there now"


def test_inputs_are_found_by_their_endings(tmp_path: Path) -> None:
    for name in ("b.ply", "a.xyz", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in inputs_in(tmp_path)] == ["a.xyz", "b.ply"]


def test_a_folder_without_inputs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no input"):
        Complete("sofas", (tmp_path,), tmp_path / "out").run()


def test_a_folder_takes_no_mask(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--mask was given with the folder"):
        Complete("sofas", (tmp_path,), tmp_path / "out", mask=tmp_path / "mask.png").run()


def test_where_nothing_can_be_completed_the_command_lists_why(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    (folder / "a.xyz").write_text("0 0 0\n")
    (folder / "b.npz").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="none of the 2 inputs could be completed"):
        Complete("sofas", (folder,), tmp_path / "out", jobs=1).run()
    rows = json.loads((tmp_path / "out" / "result.json").read_text())["rows"]
    assert [(row["input"], row["verdict"]) for row in rows] == [("a.xyz", "refused"), ("b.npz", "refused")]
    assert "1 points of the object are known" in rows[0]["reason"]
