"""``benchmarks/accuracy/mesh_depth.py`` takes meshes back to the axes of their scene."""

import sys
from pathlib import Path

import numpy as np
import pytest
from random_runs import ring

from polarguide.capture.presentation import Presentation
from polarguide.geometry.scene_frame import scene_frame
from polarguide.results.export.formats import write_mesh
from polarguide.results.export.placement import Placement
from polarguide.results.rendering.mesh import ColoredMesh, Surface

trimesh = pytest.importorskip("trimesh")
sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks" / "accuracy"))

import mesh_depth  # noqa: E402

UP = (0.3, 0.8, -0.5)


@pytest.mark.parametrize(
    "presentation",
    [Presentation(), Presentation(up_axis=UP), Presentation(up_axis=UP, meters_per_unit=0.2)],
    ids=["plain", "turned", "turned-scaled"],
)
def test_a_mesh_is_in_the_axes_of_its_scene(presentation: Presentation, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2)
    vertices, faces = np.asarray(ball.vertices) * (1, 2, 3), np.asarray(ball.faces)
    normals = vertices / (1, 4, 9)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = ColoredMesh(Surface(vertices, faces, normals), np.full((len(vertices), 3), 0.5, np.float32))
    around = scene_frame(list(ring().values()))
    placement = Placement.of(presentation, presentation.upright(around))
    write_mesh(tmp_path / "mesh.ply", mesh, around, placement)
    found = mesh_depth.scene_mesh(tmp_path / "mesh.ply")
    np.testing.assert_allclose(found.vertices, vertices, atol=1e-5)
    np.testing.assert_allclose(found.vertex_normals, normals, atol=1e-5)
    if placement.changes:
        stored = trimesh.load(tmp_path / "mesh.ply", process=False).vertices
        assert float(np.abs(stored - vertices).max()) > 0.1
