"""A trained scene's mesh as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from polarguide.color import srgb_encode
from polarguide.errors import optional_import
from polarguide.files import write_whole
from polarguide.rendering.mesh import ColoredMesh
from polarguide.scene_frame import SceneFrame


def write_mesh(path: Path, mesh: ColoredMesh, around: SceneFrame) -> None:
    """Write a mesh: PLY in world axes with display colors, or GLB, upright (+y), with linear colors as glTF has them.

    Raises:
        PolarguideError: trimesh is not installed.
    """
    trimesh = optional_import("trimesh", "--format mesh")
    binary = path.suffix.lower() == ".glb"
    shown = torch.from_numpy(mesh.colors)
    values = (shown if binary else srgb_encode(shown)).mul(255).round().to(torch.uint8).numpy()
    made = trimesh.Trimesh(
        vertices=mesh.surface.vertices,
        faces=mesh.surface.faces,
        vertex_normals=mesh.surface.normals,
        vertex_colors=np.concatenate((values, np.full((len(values), 1), 255, np.uint8)), axis=1),
        process=False,
        validate=False,
    )
    if binary:
        pose = np.eye(4)
        pose[:3, :3] = around.panorama_axes().T.numpy()
        scene = trimesh.Scene()
        scene.add_geometry(made, node_name="mesh", geom_name="mesh", transform=pose)
        data = scene.export(file_type="glb", include_normals=True)
    else:
        data = made.export(file_type="ply", vertex_normal=True)
    write_whole(path, data)
