"""Where all but the object is black to the camera, nothing may stand before the object: black would cut it off."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from polarguide.geometry.camera import Camera
from polarguide.synth.build import _mesh
from polarguide.synth.colmap import place_cameras
from polarguide.synth.settings import PRESETS, find_scene

POINTS = 20_000


def spread(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Points all over the triangles, more of each where there are few."""
    side = max(2, int(np.sqrt(2 * POINTS / len(faces))))
    a, b = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)))
    a, b = a[a + b <= 1], b[a + b <= 1]
    corners = vertices[faces]
    points = corners[:, None, 0] + a[:, None] * (corners[:, 1:2] - corners[:, :1])
    return (points + b[:, None] * (corners[:, 2:3] - corners[:, :1])).reshape(-1, 3)


def projected(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = (points - camera.center.numpy()) @ camera.rotation.numpy().T
    return local[:, :2] / np.maximum(local[:, 2:], 1e-9), local[:, 2]


@pytest.mark.parametrize("name", [name for name in PRESETS if find_scene(name).object_only])
def test_nothing_stands_before_the_object(name: str) -> None:
    spec = find_scene(name)
    meshes = {thing.name: _mesh(thing, spec) for thing in spec.things}
    subject = np.concatenate([meshes[thing.name].points for thing in spec.things if thing.foreground])
    subject = subject[ConvexHull(subject).vertices]
    others = {
        thing.name: spread(meshes[thing.name].points, meshes[thing.name].faces)
        for thing in spec.things
        if not thing.foreground and meshes[thing.name].points[:, 2].max() > subject[:, 2].min() + 0.01
    }
    for camera in place_cameras(spec.camera, 192, 144, 0):
        shown, depth = projected(camera, subject)
        outline = Delaunay(shown)
        for other, points in others.items():
            where, away = projected(camera, points)
            before = (away > 0) & (away < depth.max()) & (outline.find_simplex(where) >= 0)
            assert not before.any(), f"{other} hides a part of the object"
