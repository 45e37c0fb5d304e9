"""Depth maps of a known sphere become its mesh."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from random_runs import ring
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import scene_frame
from polarguide.results.export.mesh import write_mesh
from polarguide.results.rendering.mesh import (
    Surface,
    box_around,
    fuse,
    largest_pieces,
    scene_mesh,
    seen_points,
)
from polarguide.shading.result import RenderResult

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("skimage")
CAMERAS = ring(10, width=96, height=72)
COLOR = torch.tensor([0.8, 0.2, 0.05])


def sphere(camera: Camera) -> RenderResult:
    """A unit sphere about the origin, of one color, as the renderer would show it."""
    rays = camera.world_rays(dtype=torch.float64)
    center = camera.center
    along = rays @ center
    root = along**2 - (center @ center - 1)
    hit = root > 0
    distance = -along - root.clamp(min=0).sqrt()
    points = center + distance[..., None] * rays
    depth = torch.where(hit, (points - center) @ camera.rotation[2], torch.zeros(()).double())
    alpha, zero = hit.float(), torch.zeros(*hit.shape, 3)
    normal = torch.where(hit[..., None], points, torch.zeros(()).double()).float()
    base = alpha[..., None] * COLOR
    return RenderResult(base, zero, base, base, None, None, normal, depth.float(), alpha, Tensor())


def test_seen_points_lie_on_the_sphere() -> None:
    camera = CAMERAS["v0"]
    seen = sphere(camera)
    assert seen.depth is not None
    points = seen_points(camera, seen.depth, seen.alpha > 0.5)
    torch.testing.assert_close(points.norm(dim=1), torch.ones(len(points)).double(), atol=1e-5, rtol=0)


def test_the_field_is_the_distance_near_the_surface() -> None:
    views = [(camera, sphere(camera)) for camera in CAMERAS.values()]
    points = [seen_points(c, s.depth, s.alpha > 0.5) for c, s in views]  # type: ignore[arg-type]
    box = box_around(points, torch.zeros(3).double(), 4.0, 48)
    field, weight = fuse(box, ((c, s.depth, s.alpha > 0.5) for c, s in views))  # type: ignore[misc]
    assert float(field.abs().max()) <= 1
    assert int(weight.max()) <= len(views)


def test_a_mesh_of_the_sphere(tmp_path) -> None:  # type: ignore[no-untyped-def]
    mesh = scene_mesh(CAMERAS, sphere, resolution=64)
    radius = np.linalg.norm(mesh.surface.vertices, axis=1)
    assert abs(float(np.median(radius)) - 1) < 0.02
    assert float(np.abs(radius - 1).max()) < 0.12
    cosine = (mesh.surface.normals * mesh.surface.vertices).sum(axis=1) / radius
    assert float(np.median(cosine)) > 0.99
    assert float((cosine > 0).mean()) > 0.97, "normals point outward, but at the rim of what no camera sees"
    corners = mesh.surface.vertices[mesh.surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert float(((across * corners.mean(axis=1)).sum(axis=1) > 0).mean()) > 0.97, "faces turn outward"
    np.testing.assert_allclose(np.median(mesh.colors, axis=0), COLOR.numpy(), atol=0.02)

    around = scene_frame(list(CAMERAS.values()))
    for name in ("mesh.ply", "mesh.glb"):
        write_mesh(tmp_path / name, mesh, around)
    ply = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_allclose(ply.vertices, mesh.surface.vertices, atol=1e-5)
    np.testing.assert_allclose(ply.vertex_normals, mesh.surface.normals, atol=1e-3)
    assert np.median(ply.visual.vertex_colors[:, 0]) == pytest.approx(231, abs=3)  # sRGB of 0.8
    scene = trimesh.load(tmp_path / "mesh.glb", process=False)
    glb = scene.to_geometry()
    assert len(glb.faces) == len(mesh.surface.faces)
    upright = mesh.surface.vertices @ around.panorama_axes().numpy()
    np.testing.assert_allclose(np.sort(glb.vertices[:, 1]), np.sort(upright[:, 1]), atol=1e-5)
    assert np.median(glb.visual.vertex_colors[:, 0]) == pytest.approx(0.8 * 255, abs=3)  # linear


def test_nothing_to_see_is_said() -> None:
    def nothing(camera: Camera) -> RenderResult:
        seen = sphere(camera)
        return RenderResult(
            *(getattr(seen, f) if f != "alpha" else 0 * seen.alpha for f in seen.__dataclass_fields__)
        )

    with pytest.raises(PolarguideError, match="expected surfaces before the cameras, found none"):
        scene_mesh(CAMERAS, nothing, resolution=32)


def test_small_pieces_go() -> None:
    ball, crumb = trimesh.creation.icosphere(3), trimesh.creation.icosphere(0, radius=0.1)
    vertices = np.concatenate((crumb.vertices + 5, ball.vertices))
    faces = np.concatenate((crumb.faces, ball.faces + len(crumb.vertices)))
    kept = largest_pieces(Surface(vertices, faces, vertices), 0.05)
    assert len(kept.vertices) == len(ball.vertices)
    np.testing.assert_allclose(kept.vertices[kept.faces], ball.vertices[ball.faces])
