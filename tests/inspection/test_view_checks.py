"""Exposures and focal lengths of views by the points that they have in common."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from glossy_ball import camera_at

import polarguide
from polarguide.capture.point_exposures import PointExposures
from polarguide.inspection.capture import read_capture
from polarguide.inspection.picture_checks import lens_check, view_exposure_check


def exposed(scene: Path, out: Path, stops: np.ndarray, channels: np.ndarray) -> dict[str, np.ndarray]:
    """A copy of a scene with views that are exposed otherwise by ``stops`` [V], in [3] channels; gains by view."""
    shutil.copytree(scene, out)
    names = sorted({path.name[:-8] for path in (out / "polar").glob("*.png")})
    gains = {name: 2.0 ** (stop * channels) for name, stop in zip(names, stops, strict=True)}
    for path in sorted((out / "polar").glob("*.png")):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        scaled = 0.7 * picture * gains[path.name[:-8]][::-1]
        cv2.imwrite(str(path), np.rint(np.minimum(scaled, 65534)).astype(np.uint16))
    return gains


@pytest.mark.parametrize("channels", [(1.0, 1.0, 1.0), (1.0, 0.0, -1.0)], ids=["exposure", "white balance"])
def test_views_on_automatic_exposure_are_named_and_made_even(
    whole_demo: Path, tmp_path: Path, channels: tuple[float, float, float]
) -> None:
    stops = np.random.default_rng(4).uniform(-0.5, 0.5, 50)
    gains = exposed(whole_demo, tmp_path / "auto", stops, np.array(channels))
    check = view_exposure_check(read_capture(tmp_path / "auto"))
    assert check.verdict == "warning"
    strong = {name for name, stop in zip(gains, stops - stops.mean(), strict=True) if abs(stop) > 0.35}
    assert len(strong - set(check.views)) <= 0.1 * len(strong)
    scene = polarguide.load_scene(tmp_path / "auto", downscale=2)
    assert any("exposure or white balance" in text for text in scene.warnings)
    even = polarguide.load_scene(whole_demo, downscale=2)
    true = np.log2(np.array(list(gains.values())))
    found = np.log2(np.array([view.gains for view in scene.views]))
    # Gains that are not significant stay 1: half of the third of a stop by which cameras set exposures may remain.
    assert np.sqrt(((found - true + true.mean(axis=0)) ** 2).mean()) < 1 / 6 < true.std()
    view, before = scene.views[7], even.views[7]
    expected = before.photograph().numpy() * 0.7 * 2.0 ** (true[7] - found[7])
    np.testing.assert_allclose(view.photograph().numpy(), expected, atol=2e-4)
    np.testing.assert_allclose(view.intensities().mean(dim=0).numpy(), expected, atol=2e-4)


def test_views_of_one_exposure_get_no_gain(whole_demo: Path) -> None:
    check = view_exposure_check(read_capture(whole_demo))
    assert check.verdict == "ok"
    assert 0 < check.figures["error_stops"] < 0.15
    assert {view.gains for view in polarguide.load_scene(whole_demo, downscale=4).views} == {(1.0, 1.0, 1.0)}


def test_too_few_points_do_not_confirm_equal_exposures() -> None:
    unsure = PointExposures(np.full((6, 3), 0.2), np.full(6, 0.7), np.full(6, 0.5), np.full(6, 30))
    views = [SimpleNamespace(name=str(k)) for k in range(6)]
    capture = SimpleNamespace(exposures=unsure, views=views, keeps_gains=False)
    assert view_exposure_check(capture).verdict == "not verified"  # type: ignore[arg-type]


def test_gains_none_leaves_exposures(whole_demo: Path, tmp_path: Path) -> None:
    exposed(whole_demo, tmp_path / "auto", np.linspace(-0.5, 0.5, 50), np.ones(3))
    about = json.loads((tmp_path / "auto" / "scene.json").read_text())
    about["prepare"] = {"request": {"settings": {"gains": "none"}}}
    (tmp_path / "auto" / "scene.json").write_text(json.dumps(about))
    assert {view.gains for view in polarguide.load_scene(tmp_path / "auto", downscale=4).views} == {
        (1.0, 1.0, 1.0)
    }
    check = view_exposure_check(read_capture(tmp_path / "auto"))
    assert check.verdict == "warning"
    assert "--gains none" in check.remedy


class Model:
    """A model of points whose views were taken with focal lengths of their own."""

    def __init__(self, focal_lengths: list[float]) -> None:
        rng = np.random.default_rng(0)
        self._places = rng.uniform(-0.7, 0.7, (200, 3))
        self._noise = rng.normal(0, 0.05, (len(focal_lengths), 200, 2))
        self._focal_lengths = focal_lengths

    def camera(self, view: str):
        return camera_at(0.3 * int(view), 0.4, 0.0)

    def correspondences(self, view: str) -> tuple[np.ndarray, np.ndarray]:
        camera = self.camera(view)
        local = self._places @ camera.rotation.numpy().T + camera.translation.numpy()
        focal = np.array([camera.fx, camera.fy]) * self._focal_lengths[int(view)]
        seen = local[:, :2] / local[:, 2:] * focal + [camera.cx, camera.cy]
        return seen + self._noise[int(view)], self._places


@pytest.mark.parametrize(
    ("focal_lengths", "verdict"),
    [([1.0] * 6, "ok"), ([1.0] * 5 + [1.03], "warning"), ([0.8] * 3 + [1.25] * 3, "wrong")],
)
def test_several_focal_lengths_under_one_camera_are_found(focal_lengths: list[float], verdict: str) -> None:
    model = Model(focal_lengths)
    views = tuple(SimpleNamespace(name=str(k)) for k in range(6))
    check = lens_check(SimpleNamespace(model=model, posed=views))  # type: ignore[arg-type]
    assert check.verdict == verdict
    assert set(check.views) == {str(k) for k, length in enumerate(focal_lengths) if length != 1}
    for name, change in check.figures["views"].items():
        assert change + 1 == pytest.approx(focal_lengths[int(name)], rel=0.02)
