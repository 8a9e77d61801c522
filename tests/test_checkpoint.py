"""Models on disk: every dialect that writers of DeepSDF's folders have used, and everything that can be wrong."""

import io
import json
import os
import pickle
import re
import warnings
import zipfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from test_decoder import arrays, deepsdf, randomised

from distrace.checkpoints.model import Model, bundled_models, load_model, save_experiment, save_model
from distrace.errors import DoubtfulResult
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.files import atomic_write
from distrace.prior import prior_of

torch.set_num_threads(1)

SPECS = NetworkSpecs(dims=(12, 13, 14), code_length=3, latent_in=(2,), norm_layers=(0, 1, 2))
LAYER_NORM = replace(SPECS, weight_norm=False, norm_layers=(0, 1, 2, 3))
UNNORMED = replace(SPECS, weight_norm=False, norm_layers=())
CODES = torch.randn(4, 3, generator=torch.manual_seed(3)) * 0.3
POINTS = torch.rand(50, 3, generator=torch.manual_seed(4)) * 2 - 1
WEIGHTS, LATENTS = Path("ModelParameters/latest.pth"), Path("LatentCodes/latest.pth")


def content(specs: NetworkSpecs) -> dict:
    """`specs.json` as the original's authors write it."""
    network = asdict(specs)
    length = network.pop("code_length")
    network["latent_dropout"] = False
    return {"NetworkArch": "deep_sdf_decoder", "NetworkSpecs": network, "CodeLength": length, "CodeBound": 1.0}


def weights(specs: NetworkSpecs) -> dict[str, torch.Tensor]:
    return randomised(specs).float().state_dict()


def put(path: Path, stored: object, **how) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(stored, path, **how)
    return path


def experiment(folder: Path, specs=SPECS, *, state=None, latent=CODES, spec=None, name="latest.pth", **how) -> Path:
    """A folder in DeepSDF's layout."""
    state = weights(specs) if state is None else state
    put(folder / "ModelParameters" / name, {"epoch": 7, "model_state_dict": state}, **how)
    put(folder / "LatentCodes" / name, {"epoch": 7, "latent_codes": latent}, **how)
    (folder / "specs.json").write_text(json.dumps(content(specs) if spec is None else spec))
    return folder


def assert_same_fields(model: Model, specs: NetworkSpecs = SPECS, codes=CODES, seed: int = 0) -> None:
    assert model.codes.shape == codes.shape
    state = arrays(randomised(specs, seed))
    for number, code in enumerate(codes):
        expected = deepsdf(specs, state, code.numpy(), POINTS.numpy())
        np.testing.assert_allclose(model.field(number)(POINTS), expected, atol=1e-5)


def with_module(state):
    return {f"module.{key}": value for key, value in state.items()}


def classic(state):
    renamed = {key.replace("parametrizations.weight.original0", "weight_g"): value for key, value in state.items()}
    return {key.replace("parametrizations.weight.original1", "weight_v"): value for key, value in renamed.items()}


DIALECTS = {
    "torch's newer names": lambda state: state,
    "newer names, DataParallel": with_module,
    "weight_g and weight_v": classic,
    "as the original writes": lambda state: with_module(classic(state)),
    "half precision": lambda state: {key: value.half().float().half() for key, value in state.items()},
    "with a head that predicts stiffness": lambda state: state | {"homogen_network.0.weight": torch.zeros(64, 3)},
    "with a head, DataParallel": lambda state: with_module(state | {"homogen_network.0.bias": torch.zeros(64)}),
    "parameters": lambda state: {key: torch.nn.Parameter(value) for key, value in state.items()},
    "torch.compile": lambda state: {f"_orig_mod.{key}": value for key, value in state.items()},
    "compiled within DataParallel": lambda state: with_module({f"_orig_mod.{k}": v for k, v in classic(state).items()}),
    "a compiled layer": lambda state: {key.replace("lin1.", "lin1._orig_mod.module."): v for key, v in state.items()},
    "arrays of NumPy": lambda state: {key: value.numpy() for key, value in state.items()},
}


@pytest.mark.parametrize("specs", [SPECS, LAYER_NORM, UNNORMED, replace(SPECS, norm_layers=(1,))], ids=str)
@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_of_weights_is_the_same_field(tmp_path, dialect, specs):
    model = load_model(experiment(tmp_path / "chairs", specs, state=DIALECTS[dialect](weights(specs))))
    tolerance = 1e-2 if dialect == "half precision" else 1e-5
    expected = deepsdf(specs, arrays(randomised(specs)), CODES[1].numpy(), POINTS.numpy())
    np.testing.assert_allclose(model.field(1)(POINTS), expected, atol=tolerance)
    assert model.name == "chairs"
    assert not any(parameter.requires_grad for parameter in model.decoder.parameters())
    assert not model.decoder.training


def test_files_of_torch_before_1_6_are_read(tmp_path):
    assert_same_fields(load_model(experiment(tmp_path, _use_new_zipfile_serialization=False)))


@pytest.mark.parametrize(
    "latent",
    [
        CODES,
        CODES[:, None],
        {"weight": CODES},
        torch.nn.Embedding.from_pretrained(CODES).state_dict(),
        list(CODES),
        list(CODES[:, None]),
        {str(number): code for number, code in enumerate(CODES)},
        torch.nn.Parameter(CODES),
        CODES.double(),
        CODES.numpy(),
        list(CODES.numpy()),
    ],
    ids=[
        *("n L", "n 1 L", "weight", "embedding", "list", "list of 1 L", "parameter list", "parameter", "double"),
        *("array", "arrays"),
    ],
)
def test_every_dialect_of_codes_is_the_same_model(tmp_path, latent):
    model = load_model(experiment(tmp_path, latent=latent))
    assert_same_fields(model)
    assert model.codes.dtype == torch.float32
    assert not model.codes.requires_grad


def test_codes_that_vary_over_space_are_the_control_points(tmp_path):
    experiment(tmp_path)
    splines = {
        "0.torch_spline.control_points": CODES[:2],
        "0.torch_spline.knot_vector_0": torch.zeros(4),
        "0.torch_spline.degrees": torch.ones(3, dtype=torch.int64),
        "1.torch_spline.control_points": CODES[2:],
    }
    put(tmp_path / LATENTS, {"latent_fields_state_dict": splines, "latent_codes": torch.zeros(2, 3)})
    assert_same_fields(load_model(tmp_path))


def test_a_specification_needs_no_more_than_dims_and_a_code_length(tmp_path):
    specs = replace(UNNORMED, latent_in=())
    spec = {"NetworkSpecs": {"dims": list(specs.dims)}, "CodeLength": 3}
    assert_same_fields(load_model(experiment(tmp_path, specs, spec=spec)), specs)


@pytest.mark.parametrize("classic_file", [True, False])
@pytest.mark.parametrize(
    "epoch", [np.int64(7), np.float32(7), np.bool_(True), np.arange(3)], ids=lambda e: str(e.dtype)
)
def test_an_epoch_of_numpy_is_no_obstacle(tmp_path, epoch, classic_file):
    experiment(tmp_path)
    how = {"_use_new_zipfile_serialization": not classic_file}
    put(tmp_path / WEIGHTS, {"epoch": epoch, "model_state_dict": weights(SPECS)}, **how)
    put(tmp_path / LATENTS, {"epoch": epoch, "latent_codes": CODES}, **how)
    assert_same_fields(load_model(tmp_path))


def test_a_specification_may_begin_with_a_byte_order_mark(tmp_path):
    path = experiment(tmp_path) / "specs.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert_same_fields(load_model(tmp_path))


def test_without_codes_there_is_a_decoder_and_a_warning(tmp_path):
    (experiment(tmp_path) / LATENTS).unlink()
    with pytest.warns(DoubtfulResult, match=f"{LATENTS} is missing: the model has a decoder, and no codes"):
        model = load_model(tmp_path)
    assert model.codes.shape == (0, 3)
    assert model.shapes == ()
    expected = deepsdf(SPECS, arrays(randomised(SPECS)), CODES[1].numpy(), POINTS.numpy())
    np.testing.assert_allclose(model.field(CODES[1])(POINTS), expected, atol=1e-5)
    assert torch.equal(model.codes_of(["sofa"]), torch.zeros(1, 3)), "training begins at zero"
    assert torch.equal(prior_of(model.codes).mean, torch.zeros(3)), "the prior is DeepSDF's"


STAND_INS = {
    "Git LFS pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 7368013\n",
    "web page": b"\n<!DOCTYPE html>\n<html><title>Sign in</title></html>",
}


@pytest.mark.parametrize("name", STAND_INS)
@pytest.mark.parametrize("file", [WEIGHTS, LATENTS, Path("specs.json"), Path("model.safetensors")], ids=str)
def test_what_lies_in_place_of_a_file_that_was_not_downloaded_is_named(tmp_path, file, name):
    (experiment(tmp_path) / file).write_bytes(STAND_INS[name])
    sentence = refused(tmp_path)
    assert str(tmp_path / file) in sentence
    assert f"it is a {name}" in sentence


def test_null_is_as_good_as_nothing(tmp_path):
    specs = replace(UNNORMED, latent_in=())
    keys = "latent_in norm_layers weight_norm xyz_in_all use_tanh dropout dropout_prob latent_dropout geom_dimension"
    network = {"dims": list(specs.dims)} | dict.fromkeys(keys.split())
    spec = {"NetworkArch": None, "NetworkSpecs": network, "CodeLength": 3, "Shapes": None}
    assert_same_fields(load_model(experiment(tmp_path, specs, spec=spec)), specs)


def test_without_latest_the_checkpoint_of_most_epochs_is_taken(tmp_path):
    for epoch, seed in (("500", 1), ("2000", 2), ("1000", 3), ("best", 4)):
        experiment(tmp_path, state=randomised(SPECS, seed).float().state_dict(), name=f"{epoch}.pth")
    assert_same_fields(load_model(tmp_path), seed=2)
    experiment(tmp_path, state=randomised(SPECS, 5).float().state_dict())
    assert_same_fields(load_model(tmp_path), seed=5)


def test_the_path_may_be_text_and_shapes_without_names_are_numbered(tmp_path):
    model = load_model(str(experiment(tmp_path)))
    assert model.shapes == ("0", "1", "2", "3")


def test_loading_leaves_the_random_numbers_alone(tmp_path):
    experiment(tmp_path)
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    load_model(tmp_path)
    torch.testing.assert_close(torch.rand(3), expected)


def test_a_code_that_the_model_has_not_is_named(tmp_path):
    model = load_model(experiment(tmp_path / "chairs"))
    for number in (4, -1):
        with pytest.raises(ValueError, match=rf"^code {number} was given; chairs has 4, counted from 0$"):
            model.field(number)
    with pytest.raises(ValueError, match=r"^a code of shape \[5\] was given; this decoder takes \[3\]$"):
        model.field(torch.zeros(5))


def test_a_shape_that_the_model_has_not_names_close_ones():
    model = load_model("sofas")
    with pytest.raises(ValueError, match=r"^sofas has no shape 'nope'; see `model\.shapes`$"):
        model.code_of("nope")
    with pytest.raises(ValueError, match=r"'beige-sofa-2-seat'; did you mean beige-sofa-2-seats or"):
        model.code_of("beige-sofa-2-seat")


def test_a_model_is_equal_by_value_and_fits_on_a_line(tmp_path):
    model = load_model(experiment(tmp_path / "chairs"))
    assert repr(model) == "Model('chairs', 4 shapes, codes=float32[4, 3], 12-13-14)"
    assert repr(model.field(0)) == "ShapeField(12-13-14, code=float32[3])"
    assert repr(model.field(model.codes)) == "BatchField(4 shapes, codes=float32[4, 3])"
    assert model == replace(model, codes=model.codes.clone())
    assert model != replace(model, codes=model.codes + 1)


def test_a_name_that_is_nothing_lists_the_bundled_models(tmp_path, monkeypatch):
    save_model(tmp_path / "lamps", load_model(experiment(tmp_path / "experiment")))
    monkeypatch.setattr("distrace.checkpoints.model.BUNDLED", tmp_path)
    assert bundled_models() == ["experiment", "lamps"]
    assert refused("no-such-name") == "no-such-name is neither a folder nor a bundled model (experiment, lamps)"
    assert load_model("lamps").name == "lamps"


def refused(folder: Path | str) -> str:
    """The one sentence that loading ends in."""
    with pytest.raises(ValueError) as caught:
        load_model(folder)
    assert type(caught.value) is ValueError
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert ". " not in sentence
    assert "Re-running" not in sentence  # torch's advice to run what is in the file
    return sentence


def test_the_bundled_models_are_named_or_there_are_none():
    assert all(name in refused("no-such-name") for name in bundled_models())


def test_a_folder_that_is_missing_empty_or_a_file(tmp_path):
    assert refused(tmp_path / "gone").startswith(f"{tmp_path / 'gone'} is neither a folder nor a bundled model")
    (tmp_path / "empty").mkdir()
    assert refused(tmp_path / "empty").startswith(
        f"{tmp_path / 'empty'} is not a DeepSDF experiment: it has no specs.json"
    )
    assert "neither a folder" in refused(experiment(tmp_path / "whole") / "specs.json")


def edited(**changes) -> dict:
    spec = content(SPECS)
    spec["NetworkSpecs"] |= {key: value for key, value in changes.items() if key in spec["NetworkSpecs"]}
    return spec | {key: value for key, value in changes.items() if key not in spec["NetworkSpecs"]}


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        ([1, 2], "is not a DeepSDF specification"),
        ("text", "is not a DeepSDF specification"),
        (None, "is not a DeepSDF specification"),
        ({}, "is not a DeepSDF specification (no key 'NetworkSpecs')"),
        ({"NetworkSpecs": {}, "CodeLength": 3}, "(no key 'dims')"),
        ({"NetworkSpecs": {"dims": [8]}}, "(no key 'CodeLength')"),
        ({"NetworkSpecs": [8], "CodeLength": 3}, "is not a DeepSDF specification"),
        (edited(dims=512), "is not a DeepSDF specification"),
        (edited(dims=None), "is not a DeepSDF specification"),
        (edited(dims=["wide"]), "is not a DeepSDF specification (invalid literal for int() with base 10: 'wide')"),
        (edited(latent_in=4), "is not a DeepSDF specification"),
        (edited(norm_layers=["first"]), "is not a DeepSDF specification"),
        (edited(dropout_prob="often"), "is not a DeepSDF specification"),
        (edited(CodeLength=None), "is not a DeepSDF specification"),
        (edited(CodeLength=[1, 2]), "is not a DeepSDF specification"),
        (edited(dims=[12, -13, 14]), "cannot be (a code of 3 and layers of [12, -19, 14, 1] outputs"),
        (edited(dims=[0, 13, 14]), "describes a network that cannot be"),
        (edited(dims=[12, 5, 14]), "describes a network that cannot be"),
        (edited(CodeLength=-3), "describes a network that cannot be (a code of -3"),
        (edited(CodeLength=0), "describes a network that cannot be (a code of 0"),
        (edited(dims=[10**30, 13, 14]), "describes a network that cannot be"),
        (edited(dims=[10**9, 10**9]), "but specs.json asks for"),
        ({"NetworkSpecs": {"dims": [8], "geom_dimension": 2}, "CodeLength": 3}, "deep_sdf_decoder of 2-D points"),
        (edited(NetworkArch="siren"), "siren of 3-D points; only deep_sdf_decoder of 3-D points can be read"),
        (edited(NetworkArch="hierarchical", CodeLength=[1, 2]), "hierarchical of 3-D points; only deep_sdf_decoder"),
    ],
    ids=str,
)
def test_a_specification_that_is_none(tmp_path, spec, complaint):
    (experiment(tmp_path) / "specs.json").write_text(json.dumps(spec))
    sentence = refused(tmp_path)
    assert complaint in sentence
    assert str(tmp_path) in sentence
    assert "specs.json" in sentence


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000])
def test_a_specification_that_is_no_json(tmp_path, text):
    (experiment(tmp_path) / "specs.json").write_bytes(text)
    assert refused(tmp_path).startswith(f"{tmp_path / 'specs.json'} is not a DeepSDF specification")


class Runs:
    """A pickle of it makes a file when it is read."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def archive(members: dict[str, str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name, text in members.items():
            file.writestr(name, text)
    return buffer.getvalue()


FILE = pytest.mark.parametrize("file", [WEIGHTS, LATENTS], ids=["weights", "codes"])


def assert_refused_file(folder: Path, file: Path) -> str:
    """In one sentence, and without a warning of torch beside it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sentence = refused(folder)
    kind = (
        "checkpoint with the key model_state_dict"
        if file == WEIGHTS
        else "file of DeepSDF codes with the key latent_codes"
    )
    assert re.match(rf"{re.escape(str(folder / file))} is not a (DeepSDF )?{kind}", sentence)
    return sentence


NO_CHECKPOINTS = {
    "empty": b"",
    "text": b"hello world",
    "JSON": b'{"model_state_dict": 1}',
    "a zip": archive({"readme": "hello"}),
    "a zip like a checkpoint": archive({"archive/data.pkl": "hello", "archive/version": "3"}),
    "a list": [1, 2, 3],
    "another key": {"epoch": 3},
    "numbers": {"model_state_dict": {"lin0.weight": 3}, "latent_codes": 3},
    "nothing": {"model_state_dict": None, "latent_codes": None},
    "a module": {"model_state_dict": torch.nn.Linear(2, 2), "latent_codes": torch.nn.Linear(2, 2)},
}


@pytest.mark.parametrize("stored", NO_CHECKPOINTS.values(), ids=NO_CHECKPOINTS)
@FILE
def test_a_file_that_is_no_checkpoint(tmp_path, file, stored):
    path = experiment(tmp_path) / file
    path.write_bytes(stored) if isinstance(stored, bytes) else put(path, stored)
    assert_refused_file(tmp_path, file)


@FILE
def test_a_file_that_was_cut_off(tmp_path, file):
    path = experiment(tmp_path) / file
    path.write_bytes(path.read_bytes()[:-100])
    assert_refused_file(tmp_path, file)


@FILE
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_script_of_torch(tmp_path, file):
    torch.jit.script(torch.nn.Linear(2, 2)).save(str(experiment(tmp_path) / file))
    assert_refused_file(tmp_path, file)


def zipped(path: Path, stored: object) -> None:
    put(path, stored)


def of_old_torch(path: Path, stored: object) -> None:
    put(path, stored, _use_new_zipfile_serialization=False)


def bare(path: Path, stored: object) -> None:
    path.write_bytes(pickle.dumps(stored))


@pytest.mark.parametrize("write", [zipped, of_old_torch, bare])
@FILE
def test_a_pickle_that_would_run_does_not(tmp_path, file, write):
    runs = Runs(tmp_path / "marker")
    write(experiment(tmp_path) / file, {"model_state_dict": runs, "latent_codes": runs})
    sentence = assert_refused_file(tmp_path, file)
    assert sentence.endswith("(it holds something else than tensors; nothing in it was run)")
    assert not (tmp_path / "marker").exists()


def test_the_pickle_of_these_tests_does_run_where_one_lets_it(tmp_path):
    pickle.loads(pickle.dumps(Runs(tmp_path / "marker")))
    assert (tmp_path / "marker").is_dir()


def test_a_checkpoint_that_is_missing(tmp_path):
    experiment(tmp_path)
    (tmp_path / WEIGHTS).unlink()
    assert refused(tmp_path).startswith(f"{tmp_path / 'ModelParameters'} holds no checkpoint")
    (tmp_path / "ModelParameters").rmdir()
    assert refused(tmp_path).startswith(f"{tmp_path / 'ModelParameters'} holds no checkpoint")


def changed(**changes) -> dict[str, torch.Tensor]:
    """The weights with some replaced (`lin1_bias=…`), `None` taking one away."""
    state = weights(UNNORMED) | {key.replace("_", "."): value for key, value in changes.items()}
    return {key: value for key, value in state.items() if value is not None}


@pytest.mark.parametrize(
    ("state", "complaint"),
    [
        (changed(lin2_weight=None), "lacks lin2.weight, which specs.json calls for"),
        ({}, "lacks lin0.bias, which specs.json calls for"),
        (changed(lin4_weight=torch.zeros(1, 1)), "has lin4.weight, for which specs.json has no place"),
        (changed(lin1_bias=torch.zeros(9)), "lin1.bias has shape [9], but specs.json asks for [7]"),
        (changed(lin1_bias=torch.full((7,), torch.nan)), "lin1.bias has values that are not finite"),
        (changed(lin3_weight=torch.full((1, 14), torch.inf)), "lin3.weight has values that are not finite"),
        (weights(SPECS), "has lin0.parametrizations.weight.original0, for which specs.json has no place"),
    ],
    ids=["missing", "all missing", "extra", "shape", "NaN", "inf", "of another norm"],
)
def test_weights_that_are_not_the_specification_s(tmp_path, state, complaint):
    sentence = refused(experiment(tmp_path, UNNORMED, state=state))
    assert str(tmp_path / WEIGHTS) in sentence
    assert complaint in sentence


@pytest.mark.parametrize(
    ("latent", "complaint"),
    [
        (torch.zeros(4, 5), "has codes of shape [4, 5], but specs.json asks for [n, 3]"),
        (torch.zeros(4, 2, 3), "has codes of shape [4, 6], but specs.json asks for [n, 3]"),
        (CODES * torch.nan, "has latent codes that are not finite"),
        ([torch.zeros(3), torch.zeros(2)], "with the key latent_codes (stack expects each tensor to be equal size"),
        ([], "with the key latent_codes"),
        ({}, "with the key latent_codes"),
        (torch.zeros(0, 3), "with the key latent_codes"),
        (torch.tensor(1.0), "with the key latent_codes"),
        ([[0.0, 0.0, 0.0]], "with the key latent_codes"),
    ],
    ids=["length", "two per shape", "NaN", "ragged", "empty list", "empty dict", "none", "scalar", "nested lists"],
)
def test_codes_that_do_not_fit(tmp_path, latent, complaint):
    sentence = refused(experiment(tmp_path, latent=latent))
    assert str(tmp_path) in sentence
    assert complaint in sentence


def ours(folder: Path, tensors: dict[str, torch.Tensor]) -> Path:
    experiment(folder, UNNORMED)
    (folder / "model.safetensors").write_bytes(safetensors.torch.save(tensors))
    return folder


def test_our_own_file_is_preferred_and_checked_alike(tmp_path):
    state = weights(UNNORMED)
    assert_same_fields(load_model(ours(tmp_path / "whole", state | {"codes": CODES})), UNNORMED)
    flat, none = state | {"codes": CODES[0]}, state | {"codes": CODES[:0]}
    assert "has codes of shape [3], but specs.json asks for [n, 3]" in refused(ours(tmp_path / "flat", flat))
    assert "has codes of shape [0, 3]" in refused(ours(tmp_path / "none", none))
    sentence = refused(ours(tmp_path / "without", state))
    assert sentence == f"{tmp_path / 'without/model.safetensors'} is not a safetensors file of a model (no key 'codes')"
    short = {key: value for key, value in state.items() if key != "lin0.bias"} | {"codes": CODES}
    assert "model.safetensors lacks lin0.bias" in refused(ours(tmp_path / "short", short))


@pytest.mark.parametrize("damage", [b"", b"hello world", b"\xff" * 100, None], ids=["empty", "text", "garbage", "cut"])
def test_our_own_file_damaged(tmp_path, damage):
    path = ours(tmp_path, weights(UNNORMED) | {"codes": CODES}) / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-10] if damage is None else damage)
    assert refused(tmp_path).startswith(f"{path} is not a safetensors file of a model (")


def a_model(specs: NetworkSpecs) -> Model:
    return Model("chairs", randomised(specs).float().requires_grad_(False), CODES, ("a", "b", "c", "d"))


SAVED = pytest.mark.parametrize(
    "specs",
    [SPECS, LAYER_NORM, UNNORMED, replace(SPECS, norm_layers=(1,), xyz_in_all=True, use_tanh=True, dropout=(0,))],
    ids=["weight norm", "layer norm", "no norm", "all else"],
)


@SAVED
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float16, 3e-3), (torch.float32, 1e-6)])
def test_a_saved_model_comes_back(tmp_path, specs, dtype, tolerance):
    model = a_model(specs)
    save_model(tmp_path / "chairs", model, dtype)
    again = load_model(tmp_path / "chairs")
    assert (again.name, again.shapes) == (model.name, model.shapes)
    torch.testing.assert_close(again.codes, model.codes, atol=1e-3, rtol=1e-3)
    for number in range(4):
        torch.testing.assert_close(again.field(number)(POINTS), model.field(number)(POINTS), atol=tolerance, rtol=0)


@SAVED
def test_a_saved_experiment_comes_back_exactly(tmp_path, specs):
    model = a_model(specs)
    save_experiment(tmp_path / "chairs", model.decoder, model.codes.requires_grad_(), model.shapes)
    again = load_model(tmp_path / "chairs")
    assert (again.decoder.specs, again.shapes) == (specs, model.shapes)
    assert torch.equal(again.codes, model.codes)
    assert torch.equal(again.field(2)(POINTS), model.field(2)(POINTS))


def test_a_saved_experiment_has_the_names_of_the_original(tmp_path):
    save_experiment(tmp_path, Decoder(SPECS), CODES, ("a", "b", "c", "d"))
    state = torch.load(tmp_path / WEIGHTS, weights_only=True)["model_state_dict"]
    assert {"module.lin0.weight_g", "module.lin0.weight_v", "module.lin0.bias", "module.lin3.weight"} <= set(state)
    assert not any("parametrizations" in key for key in state)
    assert torch.load(tmp_path / LATENTS, weights_only=True)["latent_codes"]["weight"].shape == (4, 3)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_saving_leaves_no_parts_behind(tmp_path):
    model = a_model(SPECS)
    for _ in range(2):
        save_model(str(tmp_path / "ours"), model)
        save_experiment(tmp_path / "theirs", model.decoder, model.codes, model.shapes)
    assert set(files(tmp_path / "ours")) == {"specs.json", "model.safetensors"}
    assert set(files(tmp_path / "theirs")) == {"specs.json", str(WEIGHTS), str(LATENTS)}


def half_written(path: Path) -> None:
    with atomic_write(path) as file:
        file.write(b"half")
        raise OSError("disk full")


def test_a_file_whose_writing_fails_stays_as_it_was(tmp_path):
    path = tmp_path / "new/file"
    for expected in (None, b"old"):
        if expected:
            path.write_bytes(expected)
        with pytest.raises(OSError, match="disk full"):
            half_written(path)
        assert files(tmp_path) == ({"new/file": b"old"} if expected else {})
    with atomic_write(path) as file:
        file.write(b"whole")
        assert path.read_bytes() == b"old"
    assert files(tmp_path) == {"new/file": b"whole"}


def test_an_experiment_whose_saving_fails_stays_as_it_was(tmp_path, monkeypatch):
    model = a_model(SPECS)
    save_experiment(tmp_path, model.decoder, model.codes, model.shapes)
    before = files(tmp_path)

    def fails(stored, file):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(torch, "save", fails)
    with pytest.raises(OSError, match="disk full"):
        save_experiment(tmp_path, model.decoder, model.codes, model.shapes)
    assert files(tmp_path) == before


def test_several_codes_give_the_field_of_several_shapes() -> None:
    model = load_model("sofas")
    points = torch.rand(6, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    values = model.field(model.codes[:3]).select(torch.tensor([2, 2, 0, 1, 0, 1]))(points)
    for point, value, shape in zip(points, values, [2, 2, 0, 1, 0, 1], strict=True):
        torch.testing.assert_close(value, model.field(shape)(point))
