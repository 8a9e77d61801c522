"""Opens what the viewer shows: a model, or the folder that a command wrote."""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checkpoints.codes import code_title, model_source, named_code
from distrace.checkpoints.model import load_model
from distrace.data.observation import read_view
from distrace.data.photo_readers.transforms import read_cameras
from distrace.data.saved_scan import read_scan
from distrace.data.scan import Scan
from distrace.data.unit_sphere import UnitSphere, unit_sphere_of
from distrace.errors import error_context
from distrace.fitting.fit_scan import ScanFitConfig, fit_scan
from distrace.fitting.scan_residuals import PlacedCode
from distrace.pose import Similarity
from distrace.prior import prior_of
from distrace.reconstruction.networks import SurfaceNetwork, SurfaceSpecs
from distrace.viewer.scene import Progress, Refit, Scene, model_scene


def open_scene(name: str, code: str | None = None, device: str | torch.device = "cpu") -> Scene:
    """Opens a bundled model, a folder of a model, or the `--out` folder of complete, pose, multiview or reconstruct.

    `code` is a shape of a model: its number, its name, or a `code.npy`; by default the first. Raises `ValueError`, in
    one sentence, for anything else.
    """
    folder = Path(name)
    if (folder / "result.json").is_file() and not (folder / "specs.json").is_file():
        if code is not None:
            raise ValueError(f"--code {code} was given, and {folder} holds one shape; leave it out")
        return _result(folder, torch.device(device))
    model = load_model(name).to(device)
    code = "0" if code is None else code
    return model_scene(model, named_code(model, code), code_title(model, code), model_source(name))


def _result(folder: Path, device: torch.device) -> Scene:
    path = folder / "result.json"
    with error_context(f"{path} is not the result of a command", path):
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        name = content.get("model")
    if (folder / "checkpoint.pt").is_file():
        return _reconstruction(folder, content, device)
    if (folder / "code.npy").is_file() and name is None:
        raise ValueError(f"{path} names no model, as those of earlier versions; run its command again")
    if name is None or not (folder / "code.npy").is_file():
        instead = "a model" if name is None else f"the model, {name}, with --code"
        raise ValueError(
            f"{folder} holds no shape; give {instead}, or what complete, pose, multiview or reconstruct wrote"
        )
    model = load_model(name).to(device)
    code = named_code(model, str(folder / "code.npy"))
    scene = model_scene(model, code, f"{folder.name}, a shape of {model.name}", name)
    if (folder / "placement.json").is_file():
        scene = replace(scene, place=_placement(folder / "placement.json"))
    if (folder / "scan.npz").is_file():
        return _completion(folder, scene)
    if (folder / "posed.npz").is_file():
        view = read_view(folder / "posed.npz")
        return replace(scene, points=view.points(), cameras=(view.camera,))
    return replace(scene, cameras=_photographed(folder, content))


def _completion(folder: Path, scene: Scene) -> Scene:
    scan, cameras = read_scan(folder / "scan.npz")
    place = scene.place
    in_object = [place.camera_in_object(camera) for camera in cameras]
    return replace(scene, points=place.to_object(scan.points), cameras=in_object, refit=_refit(scene, scan, place))


def _refit(scene: Scene, scan: Scan, place: Similarity) -> Refit:
    """Returns the last round of a fit, from any code, at the placement that was found."""
    model = scene.model
    assert model is not None
    prior = prior_of(model.codes)
    config = ScanFitConfig(rounds=ScanFitConfig().rounds[-1:])

    def refit(code: Float[Tensor, "length"], progress: Progress) -> tuple[Float[Tensor, "length"], str]:
        start = PlacedCode.at(place.to(code.device), code)
        here = scan.to(code.device)

        def report(done: int) -> None:
            progress(done, config.total)

        fit = fit_scan(model.decoder, here, prior, config, start.place, report, start)
        return fit.code, f"{fit.verdict.name}: {fit.verdict.reason}"

    return refit


def _photographed(folder: Path, content: dict[str, Any]) -> list[Camera]:
    """Returns the cameras of `multiview`, in the object's frame."""
    if not (folder / "transforms.json").is_file():
        return []
    path = folder / "result.json"
    with error_context(f"{path} does not say where the object is", path):
        unit = unit_sphere_of(content["unit_sphere"])
        place = Similarity.from_matrix(torch.tensor(content["T_unit_object"]))
    return [place.camera_in_object(camera) for camera in _cameras(folder, unit)]


def _reconstruction(folder: Path, content: dict[str, Any], device: torch.device) -> Scene:
    path = folder / "checkpoint.pt"
    names = {each.name for each in fields(SurfaceSpecs)}
    with error_context(f"{path} is not the checkpoint of a reconstruction", path):
        settings = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        surface = SurfaceNetwork(SurfaceSpecs(**{key: value for key, value in settings.items() if key in names}))
        surface.load_state_dict(torch.load(path, map_location="cpu", weights_only=True)["surface"])
        unit = unit_sphere_of(content["unit_sphere"])
    field = surface.requires_grad_(False).eval().to(device)
    return Scene(
        f"{folder.name}, a reconstruction", field, cameras=_cameras(folder, unit), place=unit.similarity, device=device
    )


def _cameras(folder: Path, unit: UnitSphere) -> list[Camera]:
    """Returns the cameras of `transforms.json` in the unit sphere; none where there is no such file."""
    path = folder / "transforms.json"
    return [unit.camera_to_unit(camera).float() for camera in read_cameras(path)] if path.is_file() else []


def _placement(path: Path) -> Similarity:
    with error_context(f"{path} is not the placement of a completion", path):
        return Similarity.from_matrix(torch.tensor(json.loads(path.read_text(encoding="utf-8"))["T_input_object"]))
