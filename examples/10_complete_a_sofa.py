"""Completes a sofa that the model never saw from one depth image, and writes its mesh.

    python examples/10_complete_a_sofa.py

Writes out/sofa.ply. The depth image is the bundled observation; several views of the sofa are a longer list.
"""

from pathlib import Path

import trimesh

import distrace as dt

# %% What a camera saw: depths and a mask
observations = Path(dt.__file__).parent / "observations"
view = dt.load_view(observations / "burlap-sofa.npz")
model = dt.load_model("sofas")
model

# %% The code that explains it
config = dt.CodeFitConfig(starts=2, finalists=1)
fit = dt.fit_code(model.decoder, [view], dt.prior_of(model.codes), config, lambda done: print(".", end=""))
fit

# %% Its mesh, and the error against points of the true surface
mesh = dt.extract_mesh(model.field(fit.code), dt.MeshConfig(resolution=64))
Path("out").mkdir(exist_ok=True)
mesh.export("out/sofa.ply")
truth = trimesh.load(observations / "burlap-sofa.ply").vertices
error = dt.chamfer(mesh.sample(len(truth)), truth)
print(f"\nloss {fit.loss:.3f}, {fit.evaluations:,} evaluations, {fit.seconds:.1f} s, Chamfer x 1000 {error.sum:.2f}")
