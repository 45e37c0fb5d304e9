"""Poses that come without points: triangulated where the pictures allow it, sampled where they do not, and said so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_files import behind, smooth_light, write_shots
from heard import Heard
from relief import DEPTHS, write_relief

from polarguide.capture import load_scene
from polarguide.capture.colmap import triangulate as points_module
from polarguide.capture.colmap.files import PosedCamera, write_cameras
from polarguide.capture.colmap.triangulate import sample_visual_hull
from polarguide.errors import PolarguideError
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

FILTER = PrepareSettings(gains="none", align=False, transfer="linear")


def summary(scene: Path) -> dict:
    return json.loads((scene / "scene.json").read_text())


def ring(count: int = 8, *, radius: float = 3.0) -> dict[str, PosedCamera]:
    """Cameras all around that look at the origin."""
    cameras = {}
    for index in range(count):
        angle = 2 * np.pi * index / count
        forward = -np.array([np.sin(angle), 0, np.cos(angle)])
        right = np.cross([0, 1.0, 0], forward)
        rotation = np.stack([right, np.cross(forward, right), forward])
        translation = np.array([0, 0, radius])
        cameras[f"v{index}"] = PosedCamera(
            64, 48, "PINHOLE", (60.0, 60.0, 32.0, 24.0), rotation, translation
        )  # fmt: skip
    return cameras


@pytest.mark.parametrize("points_file", [True, False])
def test_points_are_triangulated_with_the_poses_as_they_are(tmp_path: Path, points_file: bool) -> None:
    cameras = write_relief(tmp_path / "in")
    model = tmp_path / "model"
    model.mkdir()
    write_cameras(model, cameras)
    if not points_file:
        (model / "points3D.bin").unlink()
    heard = Heard()
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(FILTER, poses=str(model)), heard)
    found = summary(tmp_path / "out")["points"]
    assert found["from"] == "triangulation with fixed poses"
    assert found["count"] > points_module.FEWEST
    assert found["reprojection_error_pixels"] < 1
    assert any(f"{found['count']} were triangulated" in text for text in heard.said)
    scene = load_scene(tmp_path / "out")
    for view in scene.views:
        given = cameras[view.name]
        np.testing.assert_allclose(view.camera.rotation, given.rotation, atol=1e-9)
        np.testing.assert_allclose(view.camera.translation, given.translation, atol=1e-9)
        assert (view.camera.fx, view.camera.cx) == pytest.approx((260, 160.5))
    height = -scene.points.numpy()[:, 2]
    off = np.abs(height[:, None] - DEPTHS).min(axis=1)
    assert np.median(off) < 0.01
    assert not (tmp_path / "out" / ".sfm").exists()


def test_pictures_without_texture_get_samples(tmp_path: Path) -> None:
    cameras = ring(5)
    for view in cameras:
        write_shots(tmp_path / "in", view, behind(smooth_light()))
    (tmp_path / "model").mkdir()
    write_cameras(tmp_path / "model", cameras)
    heard = Heard()
    settings = replace(FILTER, poses=str(tmp_path / "model"))
    prepare_scene(tmp_path / "in", tmp_path / "out", settings, heard)
    found = summary(tmp_path / "out")["points"]
    assert found["from"] == "random samples in the cameras' common field of view"
    assert any("They do not lie on the surface" in text for text in heard.said)
    places = load_scene(tmp_path / "out").points.numpy()
    assert len(places) == found["count"] > 10_000
    assert np.abs(places.mean(axis=0)).max() < 0.1


def test_a_stopped_preparation_keeps_its_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = ring(4)
    for view in cameras:
        write_shots(tmp_path / "in", view, behind(smooth_light()))
    (tmp_path / "model").mkdir()
    write_cameras(tmp_path / "model", cameras)
    settings = replace(FILTER, poses=str(tmp_path / "model"))

    def stop(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("polarguide.preparation.prepare._write_views", stop)
    with pytest.raises(KeyboardInterrupt):
        prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    monkeypatch.undo()
    monkeypatch.setattr(points_module, "_triangulated", stop)
    done = prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    assert done.views == sorted(cameras)
    assert summary(tmp_path / "out")["points"]["count"] > 1000


def test_cameras_that_look_apart_are_refused(tmp_path: Path) -> None:
    cameras = ring(4)
    turn = np.diag([-1.0, 1.0, -1.0])
    apart = {
        view: replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)
        for view, camera in cameras.items()
    }
    for view in cameras:
        write_shots(tmp_path / "in", view, behind(smooth_light()))
    (tmp_path / "model").mkdir()
    write_cameras(tmp_path / "model", apart)
    with pytest.raises(PolarguideError, match="expected poses of cameras with a common field of view"):
        prepare_scene(tmp_path / "in", tmp_path / "out", replace(FILTER, poses=str(tmp_path / "model")))
    assert not (tmp_path / "out" / "scene.json").exists()


@pytest.mark.parametrize("distorted", [False, True])
def test_samples_fill_the_hull_of_a_ball(distorted: bool) -> None:
    """Silhouettes of a ball of radius 0.5, from all around."""
    cameras = ring(12)
    y, x = np.mgrid[:48, :64] + 0.5
    # The silhouette of a ball at distance 3: sin of the half angle is 1/6.
    disc = np.hypot(x - 32, y - 24) < 60 * np.tan(np.arcsin(0.5 / 3))
    if distorted:
        parameters = (60.0, 32.0, 24.0, 0.0)
        cameras = {
            view: replace(camera, model="SIMPLE_RADIAL", parameters=parameters)
            for view, camera in cameras.items()
        }
    places = sample_visual_hull(cameras, dict.fromkeys(cameras, disc), 5000, np.random.default_rng(0))
    assert len(places) == 5000
    assert np.hypot(places[:, 0], places[:, 2]).max() < 0.56
    assert np.abs(places[:, 1]).max() < 0.56
    assert (np.linalg.norm(places, axis=1) < 0.4).mean() > 0.3
    assert np.abs(places.mean(axis=0)).max() < 0.03


def test_parallel_cameras_are_not_a_traceback() -> None:
    rotation = np.eye(3)
    cameras = {
        f"v{index}": PosedCamera(
            64, 48, "PINHOLE", (60.0, 60.0, 32.0, 24.0), rotation, np.array([-0.1 * index, 0, 0])
        )
        for index in range(3)
    }
    places = sample_visual_hull(cameras, {}, 100, np.random.default_rng(0))
    assert len(places) == 0 or (places[:, 2] > 0).all()
