"""Export of a scene's surface: a triangle mesh, and a point cloud with normals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.recfunctions import unstructured_to_structured
from plyfile import PlyData, PlyElement
from torch import Tensor

from polarguide.capture import View
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import atomic, write_whole
from polarguide.gaussians.gaussians import CORE_SHAPES
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.optics.color import srgb_encode
from polarguide.raster import Rasterize
from polarguide.results.export.placement import (
    GENERATOR,
    IN_PLACE,
    NOBODY,
    Origin,
    Placement,
    comments,
    with_comments,
)
from polarguide.results.rendering.mesh import ColoredMesh
from polarguide.shading.gbuffer import diffuse_colors
from polarguide.shading.model import Parameters, ShadingModel
from polarguide.training.callbacks import outward_directions


def write_mesh(
    path: Path,
    mesh: ColoredMesh,
    around: SceneFrame,
    placement: Placement = IN_PLACE,
    origin: Origin = NOBODY,
) -> None:
    """Write a mesh as PLY with display colors, or as GLB (+y up) with linear colors.

    Args:
        path: the file, .ply or .glb. mesh: the mesh in the scene's axes. around: the scene's frame.
        placement: placement of the PLY. The GLB uses only its scale.
        origin: author and provenance.

    Raises:
        PolarguideError: trimesh is not installed.
    """
    trimesh = optional_import("trimesh", "--format mesh")
    binary = path.suffix.lower() == ".glb"
    colors = torch.from_numpy(mesh.colors)
    values = (colors if binary else srgb_encode(colors)).mul(255).round().to(torch.uint8).numpy()
    vertices, normals = (torch.from_numpy(t) for t in (mesh.surface.vertices, mesh.surface.normals))
    if binary:
        vertices = placement.scale * vertices
    else:
        vertices = placement.points(vertices)
        normals = placement.directions(normals)
    solid = trimesh.Trimesh(
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
        scene.add_geometry(solid, node_name="mesh", geom_name="mesh", transform=pose)

        def about(tree: dict[str, Any]) -> None:
            tree["asset"] |= asset_record(placement, origin)
            # The default material of glTF is a rough metal, which shows no diffuse color.
            tree["materials"] = [{"name": "diffuse", "pbrMetallicRoughness": DIELECTRIC}]
            tree["meshes"][0]["primitives"][0]["material"] = 0

        data = scene.export(file_type="glb", include_normals=True, tree_postprocessor=about)
    else:
        data = with_comments(solid.export(file_type="ply", vertex_normal=True), comments(origin, placement))
    write_whole(path, data)


def asset_record(placement: Placement, origin: Origin) -> dict[str, Any]:
    """Return the asset record of a glTF file. The unit of glTF is the meter; ``units`` states an unknown scale."""
    units = "meters" if placement.metric else "units of the scene; their length is unknown"
    credit = origin.presentation.credit
    return {
        "generator": GENERATOR,
        **({"copyright": credit} if credit else {}),
        "extras": {**origin.record(), "units": units},
    }


DIELECTRIC = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
"""glTF material that shows vertex colors as a diffuse surface."""
OPAQUE = 0.5
"""Opacity above which a Gaussian belongs to a surface."""
FIELDS = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [
    (name, "u1") for name in ("red", "green", "blue")
]


@torch.no_grad()
def surface_points(
    gaussians: Parameters,
    shading: ShadingModel,
    views: Iterable[View],
    rasterize: Rasterize,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions, outward unit normals and linear diffuse colors, each [M, 3], of visible opaque Gaussians.

    Raises:
        PolarguideError: no opaque Gaussian is visible in any view.
    """
    outward = outward_directions(gaussians, views, rasterize)
    opaque = torch.sigmoid(gaussians["opacity_logits"]) >= OPAQUE
    indices = (opaque & (outward.norm(dim=1) > 0)).nonzero()[:, 0]
    if not len(indices):
        raise PolarguideError(
            "--format points",
            expected="opaque Gaussians that are visible in a view",
            found="none",
            remedy="Train for more steps.",
        )
    means = gaussians["means"][indices]
    side = outward[indices]
    normals = shortest_axis_normals(
        means, gaussians["quaternions"][indices], gaussians["log_scales"][indices], torch.zeros(3)
    )
    normals = torch.where((normals * side).sum(dim=1, keepdim=True) < 0, -normals, normals)
    selected = {name: gaussians[name][indices] for name in (*CORE_SHAPES, *shading.parameters)}
    return means, normals, diffuse_colors(selected, shading, -normals.contiguous())


def write_points(
    path: Path, points: Tensor, normals: Tensor, colors: Tensor, comments: Sequence[str] = ()
) -> None:
    """Write a PLY of points with comments.

    Args:
        path: the file. points, normals: [M, 3]. colors: [M, 3] encoded, in [0, 1].
    """
    values = np.concatenate((points.numpy(), normals.numpy(), np.rint(colors.numpy() * 255)), axis=1)
    table = unstructured_to_structured(values, np.dtype(FIELDS))
    with atomic(path) as temporary:
        element = PlyElement.describe(table, "vertex", comments=list(comments))
        PlyData([element], byte_order="<").write(temporary)
