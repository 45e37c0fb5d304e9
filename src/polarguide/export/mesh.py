"""A trained scene's mesh as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from polarguide.color import srgb_encode
from polarguide.errors import optional_import
from polarguide.export.placement import (
    GENERATOR,
    IN_PLACE,
    NOBODY,
    Origin,
    Placement,
    comments,
    with_comments,
)
from polarguide.files import write_whole
from polarguide.rendering.mesh import ColoredMesh
from polarguide.scene_frame import SceneFrame


def write_mesh(
    path: Path,
    mesh: ColoredMesh,
    around: SceneFrame,
    placement: Placement = IN_PLACE,
    origin: Origin = NOBODY,
) -> None:
    """Write a mesh: PLY with display colors, or GLB, upright (+y), with linear colors as glTF has them.

    Args:
        path: the file, .ply or .glb. mesh: in the scene's axes. around: its frame.
        placement: of the PLY; the GLB has its units alone. origin: whom the file is owed to.

    Raises:
        PolarguideError: trimesh is not installed.
    """
    trimesh = optional_import("trimesh", "--format mesh")
    binary = path.suffix.lower() == ".glb"
    shown = torch.from_numpy(mesh.colors)
    values = (shown if binary else srgb_encode(shown)).mul(255).round().to(torch.uint8).numpy()
    vertices, normals = (torch.from_numpy(t) for t in (mesh.surface.vertices, mesh.surface.normals))
    if binary:
        vertices = placement.scale * vertices
    else:
        vertices, normals = placement.points(vertices), placement.directions(normals)
    made = trimesh.Trimesh(
        vertices=vertices.numpy(),
        faces=mesh.surface.faces,
        vertex_normals=normals.numpy(),
        vertex_colors=np.concatenate((values, np.full((len(values), 1), 255, np.uint8)), axis=1),
        process=False,
        validate=False,
    )
    if binary:
        pose = np.eye(4)
        pose[:3, :3] = around.panorama_axes().T.numpy()
        scene = trimesh.Scene()
        scene.add_geometry(made, node_name="mesh", geom_name="mesh", transform=pose)

        def about(tree: dict[str, Any]) -> None:
            tree["asset"] |= _asset(placement, origin)

        data = scene.export(file_type="glb", include_normals=True, tree_postprocessor=about)
    else:
        data = with_comments(made.export(file_type="ply", vertex_normal=True), comments(origin, placement))
    write_whole(path, data)


def _asset(placement: Placement, origin: Origin) -> dict[str, Any]:
    """What a glTF file says of itself. Its unit is the meter; where the scale is not known, ``units`` says so."""
    units = "meters" if placement.metric else "units of the scene; how long one is, is not known"
    credit = origin.presentation.credit
    return {
        "generator": GENERATOR,
        **({"copyright": credit} if credit else {}),
        "extras": {**origin.record(), "units": units},
    }
