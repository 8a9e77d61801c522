"""Runs of maurock's DeepSDF are the fields that its network computes; what is wrong with a file is one sentence."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from distrace.checkpoints.model import load_model
from distrace.errors import DoubtfulResult

torch.set_num_threads(1)
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning")  # weight norm by its older name

WIDTH, LENGTH = 20, 5
CODES = 0.3 * np.random.default_rng(0).normal(size=(3, LENGTH)).astype(np.float32)
POINTS = torch.rand(40, 3, generator=torch.manual_seed(1)) * 2 - 1


def normed(inputs: int) -> nn.Sequential:
    layer = nn.utils.weight_norm(nn.Linear(inputs, WIDTH))
    layer.weight_g.data *= 2.5  # other than the norm of weight_v
    return nn.Sequential(layer, nn.ReLU())


def network(layers: int, skips: bool, inputs: int = LENGTH + 3) -> nn.ModuleDict:
    """A random network with the parts, and the names, of its `SDFModel`."""
    torch.manual_seed(2)
    hidden = layers - (2 if skips and layers >= 8 else 1)
    net = nn.Sequential(*(normed(WIDTH if number else inputs) for number in range(hidden)))
    skip = nn.Sequential(nn.Linear(WIDTH, WIDTH - inputs), nn.ReLU())
    final = nn.Sequential(nn.Linear(WIDTH, 1), nn.Tanh())
    return nn.ModuleDict({"net": net, "final_layer": final, "skip_layer": skip})


def values(parts: nn.ModuleDict, skips: bool, code: np.ndarray) -> torch.Tensor:
    """What its forward pass computes at `POINTS`."""
    given = torch.cat([torch.from_numpy(code).expand(len(POINTS), -1), POINTS], dim=1)
    x = given
    for number, layer in enumerate(parts["net"].children()):
        if skips and number == 3:
            x = torch.cat([parts["skip_layer"](x), given], dim=1)
        x = layer(x)
    return parts["final_layer"](x)[:, 0].detach()


def run(folder: Path, layers: int = 8, skips: bool = True, codes: object = CODES, **settings: object) -> Path:
    """A folder as its training writes one."""
    folder.mkdir(exist_ok=True)
    stated = {"clamp": True, "latent_size": LENGTH, "lr_model": 1e-5, "num_layers": layers, "pretrain_weights": "''"}
    stated |= {"skip_connections": skips, **settings}
    lines = [f"{name}: {str(value).lower()}\n" for name, value in stated.items()]
    (folder / "settings.yaml").write_text("".join(lines))
    torch.save(network(layers, skips).state_dict(), folder / "weights.pt")
    np.save(folder / "results.npy", {"best_latent_codes": codes}, allow_pickle=True)  # type: ignore[arg-type]
    return folder


def refused(folder: Path) -> str:
    with pytest.raises(ValueError) as caught:
        load_model(folder)
    sentence = str(caught.value)
    assert "\n" not in sentence
    return sentence


@pytest.mark.parametrize(("layers", "skips"), [(8, True), (10, True), (8, False), (4, False), (4, True)])
def test_a_run_is_the_field_that_its_network_computes(tmp_path: Path, layers: int, skips: bool) -> None:
    model = load_model(run(tmp_path / "run", layers, skips))
    assert (model.name, model.shapes) == ("run", ("0", "1", "2"))
    assert torch.equal(model.codes, torch.from_numpy(CODES))
    parts = network(layers, skips)
    for number, code in enumerate(CODES):
        expected = values(parts, skips and layers >= 8, code)
        assert expected.std() > 0.01
        assert torch.allclose(model.field(number)(POINTS), expected, atol=1e-6)


def test_a_network_that_versions_of_its_code_evaluate_differently_is_refused(tmp_path: Path) -> None:
    assert "has skip connections and 6 layers; what such a network computes" in refused(run(tmp_path, layers=6))


def test_a_network_with_positional_encoding_is_refused(tmp_path: Path) -> None:
    torch.save(network(8, True, inputs=LENGTH + 9).state_dict(), run(tmp_path) / "weights.pt")
    assert "takes 14 inputs, but settings.yaml has codes of 5, and points have 3" in refused(tmp_path)


@pytest.mark.parametrize(
    ("name", "damage", "complaint"),
    [
        ("settings.yaml", None, "settings.yaml is missing; it says whether the network"),
        ("settings.yaml", b"num_layers: 8\n", "settings.yaml does not describe a network of maurock's DeepSDF (no key"),
        ("settings.yaml", b"num_layers: 9\nlatent_size: 5\nskip_connections: true\n", "which settings.yaml calls for"),
        ("settings.yaml", b"num_layers: 8\nlatent_size: 5\nskip_connections: maybe\n", "does not describe a network"),
        ("weights.pt", b"no zip", "weights.pt is not a checkpoint of maurock's DeepSDF"),
        ("results.npy", b"no array", "results.npy is not a file of results"),
        ("results.npy", b"version https://git-lfs.github.com/spec/v1\n", "it is a Git LFS pointer"),
    ],
)
def test_a_file_that_is_missing_or_damaged_is_one_sentence(
    tmp_path: Path, name: str, damage: bytes | None, complaint: str
) -> None:
    path = run(tmp_path) / name
    path.unlink() if damage is None else path.write_bytes(damage)
    assert complaint in refused(tmp_path)


@pytest.mark.parametrize("cut", [10, 140, 250])
def test_results_that_were_cut_off_are_one_sentence(tmp_path: Path, cut: int) -> None:
    path = run(tmp_path) / "results.npy"
    path.write_bytes(path.read_bytes()[:cut])
    assert "results.npy is not a file of results" in refused(tmp_path)


def test_arrays_that_are_no_results_are_refused(tmp_path: Path) -> None:
    np.save(run(tmp_path) / "results.npy", CODES)
    assert "(it holds no dictionary)" in refused(tmp_path)
    np.save(tmp_path / "results.npy", {"loss": [1.0]}, allow_pickle=True)  # type: ignore[arg-type]
    assert "(no key 'best_latent_codes')" in refused(tmp_path)
    assert "has codes of shape [3, 4]" in refused(run(tmp_path, codes=CODES[:, :4]))


@pytest.mark.parametrize("codes", [[], None])
def test_without_codes_there_is_a_decoder_and_a_warning(tmp_path: Path, codes: object) -> None:
    folder = run(tmp_path, codes=codes)
    if codes is None:
        (folder / "results.npy").unlink()
    with pytest.warns(DoubtfulResult, match=r"results\.npy (is missing|has no codes yet)"):
        model = load_model(folder)
    assert model.codes.shape == (0, LENGTH)


class Runs:
    """A pickle of it makes a folder when it is opened."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("name", ["weights.pt", "results.npy"])
def test_a_pickle_that_would_run_does_not(tmp_path: Path, name: str) -> None:
    harm = Runs(tmp_path / "marker")
    folder = run(tmp_path / "run")
    if name == "weights.pt":
        torch.save({"net.0.0.bias": harm}, folder / name)
    else:
        np.save(folder / name, {"best_latent_codes": harm}, allow_pickle=True)  # type: ignore[arg-type]
    assert "nothing in it was run" in refused(folder)
    assert not (tmp_path / "marker").exists()
    pickle.loads(pickle.dumps(harm))
    assert (tmp_path / "marker").is_dir()


@pytest.mark.parametrize("name", ["builtins.eval", "numpy.load", "numpy.core.multiarray.fromfile", "os.system"])
def test_functions_of_other_modules_are_not_called(tmp_path: Path, name: str) -> None:
    module, _, function = name.rpartition(".")
    call = f"c{module}\n{function}\n(S'1'\ntR.".encode()  # of pickle's protocol 0: a call with one argument
    path = run(tmp_path) / "results.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(call)
    assert "(it holds something else than arrays; nothing in it was run)" in refused(tmp_path)
