"""Models of the Hugging Face Hub: written to a folder, read from the cache, and uploaded; without a network."""

import json
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from distrace.checkpoints.model import Model, load_model, save_experiment, save_model
from distrace.fields.decoder import Decoder, NetworkSpecs

torch.set_num_threads(1)

SPECS = NetworkSpecs(dims=(12, 13, 14), code_length=3, latent_in=(2,), norm_layers=(0, 1, 2))


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes every connection an error."""

    def connect(*_: object) -> None:
        raise AssertionError("the network was used")

    monkeypatch.setattr(socket.socket, "connect", connect)
    monkeypatch.setattr(socket, "getaddrinfo", connect)


@pytest.fixture
def model() -> Model:
    torch.manual_seed(0)
    return Model("stools", Decoder(SPECS).requires_grad_(False), 0.3 * torch.randn(2, 3), ("low", "high"))


def cached(cache: Path, repository: str, model: Model) -> Path:
    """Writes a model where the Hub's client keeps the files of a repository; returns their folder."""
    folder = cache / f"models--{repository.replace('/', '--')}"
    snapshot = folder / "snapshots" / ("a" * 40)
    model.save_pretrained(snapshot)
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text("a" * 40)
    return snapshot


def test_a_model_comes_back_from_its_folder(tmp_path: Path, model: Model) -> None:
    model.save_pretrained(tmp_path / "stools")
    assert {path.name for path in (tmp_path / "stools").iterdir()} == {"config.json", "model.safetensors", "README.md"}
    points = torch.rand(50, 3) - 0.5
    for read in (Model.from_pretrained(tmp_path / "stools"), load_model(str(tmp_path / "stools"))):
        assert (read.name, read.shapes) == ("stools", ("low", "high"))
        assert torch.allclose(read.field(1)(points), model.field(1)(points), atol=1e-3)  # half precision


def test_config_json_is_what_specs_json_is(tmp_path: Path, model: Model) -> None:
    model.save_pretrained(tmp_path / "hub")
    save_model(tmp_path / "ours", model)
    assert (tmp_path / "hub" / "config.json").read_text() == (tmp_path / "ours" / "specs.json").read_text()
    (tmp_path / "hub" / "config.json").write_text('{"model_type": "bert"}')
    with pytest.raises(ValueError, match=r"config.json is not a DeepSDF specification \(no key 'NetworkSpecs'\)$"):
        load_model(tmp_path / "hub")


def test_a_bundled_name_is_the_bundled_model() -> None:
    model = Model.from_pretrained("sofas")
    assert (model.name, model.codes.shape, model.folder) == ("sofas", (657, 256), load_model("sofas").folder)


def test_a_card_says_what_the_model_is(tmp_path: Path, model: Model) -> None:
    model.save_pretrained(tmp_path, licence="cc-by-4.0", trained_on="Two stools.")
    card = (tmp_path / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: distrace\nlicense: cc-by-4.0\n")
    assert "| shapes | 2: low, high |" in card
    assert "| network | 12-13-14, 386 weights |" in card
    assert card.endswith("## Training data\n\nTwo stools.\n")


def test_a_card_repeats_what_the_folder_of_the_model_says(tmp_path: Path, model: Model) -> None:
    save_experiment(tmp_path / "run", model.decoder, model.codes, model.shapes)
    facts = {"command": "distrace train stools", "steps": 7, "loss": 0.5, "version": "0.1"}
    (tmp_path / "run" / "result.json").write_text(json.dumps(facts))
    load_model(tmp_path / "run").save_pretrained(tmp_path / "first")
    said = "## Training data\n\n`distrace train stools`: steps 7, loss 0.5, by distrace 0.1.\n"
    assert (tmp_path / "first" / "README.md").read_text().endswith(said)
    load_model(tmp_path / "first").save_pretrained(tmp_path / "second")
    assert (tmp_path / "second" / "README.md").read_text().endswith(said)
    load_model("sofas").save_pretrained(tmp_path / "sofas")
    sofas = (tmp_path / "sofas" / "README.md").read_text()
    assert "CC-BY-3.0" in sofas.split("## Training data")[1]
    assert "license: unknown" in sofas


def test_a_folder_or_a_licence_that_cannot_be_is_refused(tmp_path: Path, model: Model) -> None:
    save_experiment(tmp_path / "run", model.decoder, model.codes, model.shapes)
    with pytest.raises(ValueError, match="run holds a DeepSDF experiment"):
        model.save_pretrained(tmp_path / "run")
    with pytest.raises(ValueError, match=r"^licence='mine: all of it' was given; give an identifier"):
        model.save_pretrained(tmp_path / "other", licence="mine: all of it")
    assert not (tmp_path / "other").exists()


def test_a_repository_is_read_from_the_cache(tmp_path: Path, model: Model) -> None:
    pytest.importorskip("huggingface_hub")
    snapshot = cached(tmp_path, "someone/stools", model)
    read = Model.from_pretrained("someone/stools", cache=tmp_path)
    assert (read.name, read.shapes, read.folder) == ("stools", ("low", "high"), snapshot)
    assert torch.equal(read.codes, load_model(snapshot).codes)
    (snapshot / "model.safetensors").unlink()
    (snapshot / "ModelParameters").mkdir()
    (snapshot / "ModelParameters" / "latest.pth").write_bytes(b"a pickle")
    with pytest.raises(ValueError, match=r"^someone/stools holds no model.safetensors: it is no model of distrace"):
        Model.from_pretrained("someone/stools", cache=tmp_path)


def test_a_repository_that_is_not_in_the_cache_says_how_to_fetch_it(tmp_path: Path) -> None:
    pytest.importorskip("huggingface_hub")
    with pytest.raises(ValueError, match=r"^someone/stools is neither a folder .* download=True fetches it$"):
        Model.from_pretrained("someone/stools", cache=tmp_path)
    with pytest.raises(ValueError, match=r"^some--one/stools could not be read from the Hugging Face Hub \("):
        Model.from_pretrained("some--one/stools", cache=tmp_path)


def test_only_download_uses_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: Model) -> None:
    hub = pytest.importorskip("huggingface_hub")
    given = {}

    def snapshot_download(repository: str, **options: object) -> str:
        given.update(options)
        model.save_pretrained(tmp_path / "fetched")
        return str(tmp_path / "fetched")

    monkeypatch.setattr(hub, "snapshot_download", snapshot_download)
    assert Model.from_pretrained("someone/stools", download=True, revision="v1").name == "stools"
    assert (given["local_files_only"], given["revision"]) == (False, "v1")
    assert given["allow_patterns"] == ["config.json", "model.safetensors", "README.md"]


def test_a_model_is_uploaded_with_its_card(monkeypatch: pytest.MonkeyPatch, model: Model) -> None:
    hub = pytest.importorskip("huggingface_hub")
    calls = []

    def upload_folder(_: object, *, repo_id: str, folder_path: Path, commit_message: str) -> SimpleNamespace:
        calls.append((repo_id, sorted(path.name for path in folder_path.iterdir()), commit_message))
        assert "# benches\n" in (folder_path / "README.md").read_text()
        return SimpleNamespace(commit_url="https://example.org/commit")

    monkeypatch.setattr(hub.HfApi, "create_repo", lambda _, name, **options: calls.append((name, options)))
    monkeypatch.setattr(hub.HfApi, "upload_folder", upload_folder)
    assert model.push_to_hub("someone/benches", licence="mit", private=True) == "https://example.org/commit"
    assert calls[0] == ("someone/benches", {"private": True, "exist_ok": True})
    files = ["README.md", "config.json", "model.safetensors"]
    assert calls[1] == ("someone/benches", files, "Upload benches")


def test_without_the_library_folders_open_and_repositories_name_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: Model
) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    model.save_pretrained(tmp_path)
    assert Model.from_pretrained(tmp_path).shapes == model.shapes
    with pytest.raises(ModuleNotFoundError, match=r"^someone/stools, .* install it by pip install 'distrace\[hub\]'$"):
        Model.from_pretrained("someone/stools")
    with pytest.raises(ModuleNotFoundError, match=r"^an upload .* install it by pip install 'distrace\[hub\]'$"):
        model.push_to_hub("someone/stools")


def test_the_library_is_imported_for_repositories_only() -> None:
    code = "import sys, distrace as dt; dt.Model.from_pretrained('sofas'); print('huggingface_hub' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
