"""Export of a scene's surface as a triangle mesh, and of points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from torch import Tensor

from polarguide.core.files import atomic
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.optics.color import srgb_encode
from polarguide.results.export.model.gltf import ELEMENTS, Binary
from polarguide.results.export.placement import (
    GENERATOR,
    IN_PLACE,
    NOBODY,
    Origin,
    Placement,
    comments,
)
from polarguide.results.rendering.mesh import ColoredMesh


def write_mesh(
    path: Path,
    mesh: ColoredMesh,
    around: SceneFrame,
    placement: Placement = IN_PLACE,
    origin: Origin = NOBODY,
) -> None:
    """Write a mesh as PLY with display colors, or as GLB (+y up) with linear colors.

    Args:
        path: the file, .ply or .glb.
        mesh: the mesh in the scene's axes.
        around: the scene's frame.
        placement: placement of a PLY file. A GLB file uses only the scale of the placement.
        origin: author and provenance.
    """
    surface = mesh.surface
    if path.suffix.lower() == ".glb":
        axes = around.panorama_axes().numpy()
        rgba = np.rint(255 * np.pad(mesh.colors, ((0, 0), (0, 1)), constant_values=1))
        binary = Binary()
        attributes = {
            "POSITION": binary.array((placement.scale * surface.vertices @ axes).astype("<f4"), bounds=True),
            "NORMAL": binary.array((surface.normals @ axes).astype("<f4")),
            "COLOR_0": binary.array(rgba.astype("u1")),
        }
        faces = binary.array(surface.faces.reshape(-1).astype("<u4"), ELEMENTS)
        primitive = {"attributes": attributes, "indices": faces, "material": 0}
        # The default material of glTF is a rough metal, which shows no diffuse color.
        material = {"name": "diffuse", "pbrMetallicRoughness": DIELECTRIC}
        binary.write(path, asset_record(placement, origin), primitive, {"materials": [material]})
        return
    points = placement.points(torch.from_numpy(surface.vertices))
    normals = placement.directions(torch.from_numpy(surface.normals))
    colors = srgb_encode(torch.from_numpy(mesh.colors))
    write_points(path, points, normals, colors, comments(origin, placement), surface.faces)


def write_points(
    path: Path,
    points: Tensor,
    normals: Tensor,
    colors: Tensor,
    remarks: Sequence[str],
    faces: NDArray[np.integer[Any]] | None = None,
) -> None:
    """Write points, and optionally the triangles between them, as a PLY file.

    Args:
        path: the file.
        points: [N, 3] positions.
        normals: [N, 3] unit normals; zero if unknown.
        colors: [N, 3] sRGB colors in [0, 1].
        remarks: comments of the file.
        faces: [F, 3] indices of the points of each triangle.
    """
    values = np.concatenate((points.numpy(), normals.numpy(), np.rint(colors.numpy() * 255)), axis=1)
    table = unstructured_to_structured(values, np.dtype(FIELDS))
    elements = [PlyElement.describe(table, "vertex", comments=list(remarks))]
    if faces is not None:
        rows = faces.astype("<i4").view([("vertex_indices", "<i4", (3,))])[:, 0]
        elements.append(PlyElement.describe(rows, "face"))
    with atomic(path) as temporary:
        PlyData(elements, byte_order="<").write(temporary)


def asset_record(placement: Placement, origin: Origin) -> dict[str, Any]:
    """Return the asset record of a glTF file.

    The unit of glTF is the meter. If the scale of the scene is unknown, the field ``units`` states this.
    """
    units = "meters" if placement.metric else "units of the scene; their length is unknown"
    credit = origin.presentation.credit
    return {
        "generator": GENERATOR,
        **({"copyright": credit} if credit else {}),
        "extras": {**origin.record(), "units": units},
    }


DIELECTRIC = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
"""glTF material that shows vertex colors as a diffuse surface."""
FIELDS = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [
    (name, "u1") for name in ("red", "green", "blue")
]
