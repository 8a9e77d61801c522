"""Clips of held-out shapes, by an independent renderer."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from distrace.cli.console import console, progress, start
from distrace.data.patches import Patch, load_patches, placed
from experiments.clips import clip, mitsuba_scene
from experiments.clips.mottled_patches import has_images, mottled_patch
from experiments.datasets.solids import mesh_of
from experiments.datasets.splits import Meshes


@dataclass(frozen=True)
class Clip:
    """Render a clip around a held-out shape with Mitsuba, for `multiview`; a second run resumes."""

    shape: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="SHAPE")]]
    split: str = "sofas"  # a bundled one, or a CSV file
    meshes: Meshes = Path("out")
    out: Path | None = None  # by default out/clips/SHAPE
    frames: int = 24
    size: int = 256
    background: clip.Background = "plain"
    texture: clip.Texture | None = None  # by default the mesh's own images where it has them, else noise
    samples: int = 64  # light paths per pixel

    def run(self) -> None:
        clip.check(self.frames, self.size, self.samples)
        shape = clip.held_out(self.split, self.shape)
        version = mitsuba_scene.mitsuba().__version__
        path = mesh_of(shape, self.meshes)
        patches = load_patches(path)
        description = clip.Clip(
            shape=shape.name,
            split=self.split,
            background=self.background,
            frames=self.frames,
            size=self.size,
            samples=self.samples,
            texture=self._texture(patches, path),
            mesh=shape.path,
            creator=shape.creator,
            licence=shape.licence,
            mitsuba=version,
        )
        run = start(self.out or Path("out/clips") / shape.name)
        clip.begin(run.out, description)
        rendered, seconds = render_frames(description, patches, shape.turn, run.out)
        per_frame = {"seconds_per_frame": seconds / rendered} if rendered else {}
        counts = {"frames": description.frames, "rendered": rendered, "cores": os.cpu_count()}
        run.finish({**counts, **per_frame})

    def _texture(self, patches: list[Patch], path: Path) -> clip.Texture:
        textured = has_images(patches)
        if self.texture == "own" and not textured:
            raise ValueError(f"images cover too little of {path}; use --texture procedural")
        return self.texture or ("own" if textured else "procedural")


def render_frames(description: clip.Clip, patches: list[Patch], turn: float, folder: Path) -> tuple[int, float]:
    """Renders the missing frames; returns their number and the seconds."""
    frames = clip.missing(folder, description)
    if not frames:
        clip.save_views(folder, description)
        return 0, 0.0
    console.print(f"{description.shape}, {description.texture} texture", markup=False)
    patches = placed(patches, turn)
    if description.texture == "procedural":
        patches = [mottled_patch(patch, description.seed) for patch in patches]
    stage = mitsuba_scene.staged(patches, description.background, description.seed)
    start_time = time.perf_counter()
    with progress("rendering", description.frames) as bar:
        for frame in frames:
            camera = description.cameras[frame]
            mask, depth = mitsuba_scene.truth(stage, camera)
            image = mitsuba_scene.photograph(stage, camera, description.samples, description.seed + frame)
            clip.save_frame(folder, frame, image, mask, depth)
            bar.advance(to=frame + 1)
    clip.save_views(folder, description)
    return len(frames), time.perf_counter() - start_time
