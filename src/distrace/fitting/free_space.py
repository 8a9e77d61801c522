"""What of a completed mesh its view contradicts: pieces that lie beside the silhouette, or before what was seen."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float

from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.fields.base import SDF
from distrace.mesh import MeshConfig, extract_mesh

if TYPE_CHECKING:
    import trimesh

MARGIN = 0.03  # of the unit sphere's radius: what is nearer to what was seen does not contradict it
PRUNED_PIECES = "left_out"


def pruned_mesh(sdf: SDF, seen: View | Cloud, config: MeshConfig) -> "trimesh.Trimesh":
    """The surface of a fitted field, less what the view contradicts; a cloud contradicts nothing.

    Raises `ValueError` where the field has no zero.
    """
    mesh = extract_mesh(sdf, config)
    return prune_pieces(mesh, seen) if isinstance(seen, View) else mesh


def prune_pieces(mesh: "trimesh.Trimesh", view: View) -> "trimesh.Trimesh":
    """The mesh without pieces, connected to nothing else, most of whose area lies where the view shows free space.

    The largest piece stays in any case. How many are gone is in the metadata, by the name `left_out`.
    """
    from trimesh.graph import connected_component_labels

    pieces = connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    whole = np.bincount(pieces, weights=mesh.area_faces)
    free = np.bincount(pieces, weights=mesh.area_faces * free_space(view, mesh.triangles_center))
    kept = free <= whole / 2
    kept[whole.argmax()] = True
    if kept.all():
        return mesh
    found = mesh.copy()
    found.update_faces(kept[pieces])
    found.remove_unreferenced_vertices()
    found.metadata[PRUNED_PIECES] = int((~kept).sum())
    return found


def free_space(view: View, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which points the view shows to be in free space: beside the mask, or before a depth, by more than the margin."""
    from scipy.ndimage import distance_transform_edt

    camera = view.camera.to("cpu")
    positions, depths = camera.project(torch.tensor(points, dtype=torch.float32))
    shown = camera.shows(positions, depths)
    x, y = positions[shown].long().T
    free = view.depth.cpu()[y, x].isfinite() & (depths[shown] < view.depth.cpu()[y, x] - MARGIN)
    if view.mask is not None:
        beside = torch.from_numpy(distance_transform_edt(~view.mask.cpu().numpy())).float()  # in pixels
        free |= beside[y, x] * depths[shown] / camera.intrinsics[0, 0] > MARGIN
    found = np.zeros(len(points), dtype=bool)
    found[shown.numpy()] = free.numpy()
    return found
