"""Colours are read from meshes, learnt, saved, and found again in photographs."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch import Tensor

from distrace.boundary import shade
from distrace.camera import Camera
from distrace.checkpoints.colours import Colours, colours_of, load_colours, named_albedo, save_colours
from distrace.checkpoints.model import Model, load_model, save_model
from distrace.cli import main
from distrace.cli.train import Train
from distrace.colour_space import to_srgb
from distrace.coloured import coloured_mesh, coloured_picture, studio
from distrace.data.coloured_points import ColouredPoints, coloured_points
from distrace.data.photograph import Photograph
from distrace.fields import primitives
from distrace.fields.colour import ColourDecoder, ColourSpecs
from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.fitting.fit_colours import ColourFitConfig, fit_colours
from distrace.lights import SphericalHarmonics, lit
from distrace.mesh import MeshConfig, extract_mesh
from distrace.pose import Similarity
from distrace.render import render
from distrace.training.colours import ColourTrainConfig, start_colours, train_colours

CUBE = """mtllib cube.mtl
{vertices}
usemtl red
f 1 3 4 2
f 5 6 8 7
usemtl blue
f 1 2 6 5
f 3 7 8 4
f 1 5 7 3
f 2 4 8 6
"""
MATERIALS = "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n"
SMALL = ColourSpecs(shape_code=4, colour_code=3, width=32, layers=2, frequencies=2)


def cube(folder: Path) -> Path:
    corners = [f"v {x} {y} {z}" for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
    (folder / "cube.mtl").write_text(MATERIALS)
    path = folder / "cube.obj"
    path.write_text(CUBE.format(vertices="\n".join(corners)))
    return path


def halves(left: tuple[float, float, float], right: tuple[float, float, float]) -> ColouredPoints:
    """Returns a sphere of two materials."""
    normals = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    is_right = normals[:, 0] > 0
    colours = np.where(is_right[:, None], right, left).astype(np.float32)
    return ColouredPoints(0.8 * normals, normals, colours, is_right.astype(int))


def test_points_have_the_colours_of_their_materials(tmp_path: Path) -> None:
    found = coloured_points(cube(tmp_path), 0.0, 600)
    side = float(np.abs(found.points).max())
    assert np.allclose(np.abs(found.points).max(1), side, atol=1e-5)
    assert np.allclose((found.points * found.normals).sum(1), side, atol=1e-5), "normals point outwards"
    ends = np.abs(found.normals[:, 2]) > 0.5
    assert np.allclose(found.colours[ends], [1, 0, 0], atol=0.25)
    assert np.allclose(found.colours[~ends], [0, 0, 1], atol=0.25)


def test_a_turn_turns_the_points(tmp_path: Path) -> None:
    found = coloured_points(cube(tmp_path), 90.0, 600)
    ends = np.abs(found.normals[:, 0]) > 0.5
    assert found.colours[ends, 0].min() > 0.6


def test_what_bounds_no_solid_has_no_points(tmp_path: Path) -> None:
    path = tmp_path / "sheet.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match="bounds no solid"):
        coloured_points(path, 0.0, 100)


def test_training_learns_each_palette() -> None:
    samples = [halves((1, 0, 0), (0, 0, 1)), halves((0, 1, 0), (1, 1, 1))]
    config = ColourTrainConfig(steps=120, palettes=1, palettes_per_step=4, learning_rate=1e-2, specs=SMALL)
    training = start_colours(2, config, torch.device("cpu"))
    codes = torch.eye(4)[:2]
    losses = list(train_colours(training, samples, codes, config))
    assert losses[-1] < 0.3 * losses[0]
    right = torch.tensor([[0.8, 0.0, 0.0]])
    found = training.decoder(right, right / 0.8, codes, training.codes)
    assert torch.allclose(found, torch.tensor([[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]), atol=0.25)


def test_colours_are_saved_and_read(tmp_path: Path) -> None:
    (tmp_path / "specs.json").write_text("{}")
    colours = Colours(ColourDecoder(SMALL), torch.randn(4, 3), ("a", "b"))
    save_colours(tmp_path, colours)
    again = load_colours(tmp_path)
    assert again is not None
    assert again.shapes == ("a", "b")
    assert torch.allclose(again.codes, colours.codes, atol=1e-2)
    points = torch.rand(5, 3)
    before = colours.decoder(points, points, torch.zeros(4), colours.codes[0])
    assert torch.allclose(again.decoder(points, points, torch.zeros(4), again.codes[0]), before, atol=1e-2)


@pytest.mark.parametrize("name", ["colours.json", "colours.safetensors"])
def test_a_damaged_file_is_one_sentence(tmp_path: Path, name: str) -> None:
    save_colours(tmp_path, Colours(ColourDecoder(SMALL), torch.randn(4, 3), ("a",)))
    (tmp_path / name).write_bytes(b"{")
    with pytest.raises(ValueError, match=name):
        load_colours(tmp_path)


def test_a_model_without_colours_says_how_it_gets_some() -> None:
    with pytest.raises(ValueError, match="train MESHES --colour --begin-with planes"):
        colours_of(load_model("planes"), "planes")


@pytest.mark.parametrize("given", ["nothing", "missing.npy"])
def test_colours_that_are_not_there_are_one_sentence(given: str) -> None:
    model = load_model("sofas")
    with pytest.raises(ValueError, match=given):
        named_albedo(model, "sofas", "0", model.codes[0], given)


def scene() -> tuple[Colours, Tensor, Tensor, Tensor, list[Photograph]]:
    """Returns a bundled shape's colours, codes and light, and two photographs of it."""
    model = load_model("sofas")
    colours = colours_of(model, "sofas")
    code = model.code_of("convertible-sofa-closed")
    colour = colours.code_of("convertible-sofa-closed")
    light = torch.zeros(9, 3)
    light[0] = 2.2
    light[1] = torch.tensor([0.8, 0.7, 0.6])
    views = []
    for azimuth in (30, 140):
        camera = Camera.orbit(azimuth, 20, 4, height=32, width=32)
        with torch.no_grad():
            buffers = render(model.field(code), camera)
            albedo = colours.decoder.albedo(code, colour)
            image = to_srgb(shade(buffers, lit(albedo, [SphericalHarmonics(light)]), torch.zeros(3)))
        views.append(Photograph(str(azimuth), camera, image, buffers.mask))
    return colours, code, colour, light, views


def test_colours_and_light_are_found_in_photographs() -> None:
    colours, code, _, _, views = scene()
    field = load_model("sofas").field(code)
    config = ColourFitConfig(steps=60, points=300)
    fit = fit_colours(colours, views, field, code, Similarity.identity(), config)
    assert fit.losses[-1] < 0.03
    with torch.no_grad():
        buffers = render(field, views[0].camera)
        albedo = colours.decoder.albedo(code, fit.colour_code)
        image = to_srgb(shade(buffers, lit(albedo, [fit.light_of(0)]), torch.zeros(3)))
    assert (image - views[0].image)[buffers.mask].abs().mean() < 0.03


def test_where_nothing_is_seen_no_colours_are_found() -> None:
    colours = Colours(ColourDecoder(SMALL), torch.randn(4, 3), ("a",))
    camera = Camera.orbit(0, 0, 4, height=8, width=8)
    view = Photograph("empty", camera, torch.zeros(8, 8, 3), torch.zeros(8, 8, dtype=torch.bool))
    with pytest.raises(ValueError, match="no photograph shows the shape"):
        fit_colours(colours, [view], primitives.sphere(0.5), torch.zeros(4), Similarity.identity())


def test_pictures_and_meshes_have_the_colours() -> None:
    model = load_model("sofas")
    code = model.code_of("convertible-sofa-closed")
    albedo = named_albedo(model, "sofas", "convertible-sofa-closed", code, "own")
    buffers = render(model.field(code), Camera.orbit(30, 20, 4, height=24, width=24))
    picture = coloured_picture(buffers, albedo, studio(buffers))
    inside = picture[buffers.mask.numpy()].mean(0)
    assert inside[2] > inside[0] + 20, "the convertible sofa is blue"
    mesh = coloured_mesh(extract_mesh(model.field(code), MeshConfig(24)), albedo)
    shown = np.asarray(mesh.visual.vertex_colors)[:, :3].mean(0)
    assert shown[2] > shown[0] + 20


def test_colours_of_vertices_and_of_glb_textures_are_read(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=np.tile([255, 0, 0, 255], (8, 1)))
    box.export(tmp_path / "vertices.ply")
    assert np.allclose(coloured_points(tmp_path / "vertices.ply", 0.0, 50).colours, [1, 0, 0])

    image = Image.new("RGB", (8, 8), (0, 255, 0))
    image.putpixel((0, 0), (0, 200, 0))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(uv=np.full((8, 2), 0.5), material=material)
    box.export(tmp_path / "textured.glb")
    assert np.allclose(coloured_points(tmp_path / "textured.glb", 0.0, 50).colours, [0, 1, 0])


def test_the_command_adds_colours_to_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    cube(meshes)
    decoder = Decoder(NetworkSpecs(dims=(16, 16), code_length=4, latent_in=(), norm_layers=()))
    save_model(tmp_path / "model", Model("model", decoder, torch.zeros(1, 4), ("cube",)))
    out = tmp_path / "out"
    arguments = ["train", str(meshes), "--colour", "--begin-with", str(tmp_path / "model"), "--steps", "2"]
    monkeypatch.setattr("sys.argv", ["distrace", *arguments, "--out", str(out)])
    main()
    assert (out / "preview.png").is_file()
    model = load_model(out)
    assert colours_of(model, out).shapes == ("cube",)

    for folder, message in ((tmp_path / "model", "is the folder of --begin-with"), (tmp_path / "run", "holds a run")):
        folder.mkdir(exist_ok=True)
        (folder / "checkpoint.pt").touch()
        command = Train(meshes, folder, begin_with=str(tmp_path / "model"), colour=True)
        with pytest.raises(ValueError, match=message):
            command.run()
    with pytest.raises(ValueError, match="--width was given, which --colour does not use"):
        Train(meshes, out, begin_with=str(tmp_path / "model"), colour=True, width=8).run()


def test_commands_draw_in_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = ["sofas", "--code", "convertible-sofa-closed", "--colour", "own", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["distrace", "render", *shape, "--size", "24"])
    main()
    picture = np.asarray(Image.open(tmp_path / "shaded.png")).astype(int)
    assert (picture[..., 2] > picture[..., 0] + 20).sum() > 20
    monkeypatch.setattr("sys.argv", ["distrace", "mesh", *shape, "--resolution", "16"])
    main()
    colours = np.asarray(trimesh.load(tmp_path / "mesh.ply").visual.vertex_colors).astype(int)
    assert colours[:, 2].mean() > colours[:, 0].mean() + 20
