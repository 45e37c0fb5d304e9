"""Epipolar geometry, one bad view among good ones, and gaps."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest
import torch
from captures import write_scene
from glossy_ball import camera_at

from polarguide.geometry.camera import Camera
from polarguide.inspection import inspect, picture_checks
from polarguide.inspection.capture import Capture, read_capture
from polarguide.inspection.inspect import PairError, _fundamental, _pair_error, epipolar_errors, view_errors


def test_projections_of_one_point_lie_on_each_others_epipolar_lines() -> None:
    first, second = camera_at(0.1, 0.3, 0.1), camera_at(0.5, 0.5, -0.2)
    place = torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64)
    pixels = []
    for camera in (first, second):
        x, y, z = (camera.rotation @ place + camera.translation).tolist()
        pixels.append(np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, 1.0]))
    line = _fundamental(first, second) @ pixels[0]
    line = line / np.hypot(*line[:2])
    assert abs(line @ pixels[1]) < 1e-9
    assert abs(line @ (pixels[1] + np.array([*(3 * line[:2]), 0]))) == pytest.approx(3)


@pytest.mark.parametrize("moved", [0.0, 0.1])
def test_cameras_in_one_place_have_no_epipolar_lines(moved: float) -> None:
    generator = np.random.default_rng(0)
    points, descriptors = (
        generator.uniform(20, 60, (50, 2)),
        generator.normal(size=(50, 128)).astype(np.float32),
    )
    turn = torch.eye(3, dtype=torch.float64)
    places = [torch.tensor([k * moved, 0, 0], dtype=torch.float64) for k in range(2)]
    cameras = [Camera(80, 80, 90.0, 90.0, 40.0, 40.0, turn, place) for place in places]
    first, second = ((f"v{k}", camera, points, descriptors) for k, camera in enumerate(cameras))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = _pair_error(first, second, 1, 0.0)
    assert (found is None) == (moved == 0.0)


def pairs(errors: dict[tuple[str, str], float]) -> list[PairError]:
    return [PairError(a, b, 50, error) for (a, b), error in errors.items()]


def ring(bad: int, count: int = 12) -> list[PairError]:
    """Every view with its two next ones; pairs of one view are bad."""
    found = {}
    for i in range(count):
        for step in (1, 2):
            j = (i + step) % count
            found[f"v{i:02d}", f"v{j:02d}"] = 6.0 if bad in (i, j) else 0.5
    return pairs(found)


def test_a_bad_view_does_not_spoil_its_neighbors() -> None:
    errors = view_errors(ring(bad=4))
    assert errors["v04"] == 6.0
    assert all(error == 0.5 for name, error in errors.items() if name != "v04")


@pytest.fixture
def posed(tmp_path) -> Capture:
    capture = read_capture(write_scene(tmp_path / "s", views=12, names="v{:02d}"))
    views = tuple(
        dataclasses.replace(view, camera=camera_at(2 * np.pi * k / 12, 0.3, 0))
        for k, view in enumerate(capture.views)
    )
    return dataclasses.replace(capture, views=views, model=object())  # type: ignore[arg-type]


def test_the_bad_view_is_named(posed, monkeypatch) -> None:
    monkeypatch.setattr(inspect, "epipolar_errors", lambda capture: ring(bad=4))
    check = inspect.pose_check(posed)
    assert check.verdict == "warning"
    assert check.views == ("v04",)
    assert "v04 (6.0 px)" in check.finding
    monkeypatch.setattr(inspect, "epipolar_errors", lambda capture: ring(bad=-1))
    assert inspect.pose_check(posed).verdict == "ok"
    everywhere = [dataclasses.replace(pair, error=5.0) for pair in ring(bad=-1)]
    monkeypatch.setattr(inspect, "epipolar_errors", lambda capture: everywhere)
    assert inspect.pose_check(posed).verdict == "wrong"


def test_a_view_without_matches_is_named_as_unchecked(posed, monkeypatch) -> None:
    others = [pair for pair in ring(bad=-1) if "v03" not in (pair.first, pair.second)]
    monkeypatch.setattr(inspect, "epipolar_errors", lambda capture: others)
    check = inspect.pose_check(posed)
    assert check.verdict == "ok"
    assert check.finding.endswith("Too few matches to check 1 of 12 views: v03.")


def test_matches_by_chance_are_not_judged() -> None:
    generator = np.random.default_rng(0)
    descriptors = generator.normal(size=(30, 128)).astype(np.float32)
    first, second = (
        (f"v{k}", camera_at(0.2 * k, 0.3, 0), generator.uniform(20, 60, (30, 2)), descriptors)
        for k in range(2)
    )
    assert _pair_error(first, second, 1, 1000.0) is not None
    assert _pair_error(first, second, 1, 0.0) is None


def test_views_without_a_pose_are_named(posed, monkeypatch) -> None:
    monkeypatch.setattr(inspect, "epipolar_errors", lambda capture: ring(bad=-1))
    views = (dataclasses.replace(posed.views[0], camera=None), *posed.views[1:])
    check = inspect.pose_check(dataclasses.replace(posed, views=views))
    assert check.verdict == "warning"
    assert check.views == ("v00",)


def test_pictures_that_share_nothing_are_not_judged(posed) -> None:
    assert inspect.pose_check(posed).verdict == "n/a"


def test_without_a_model_there_is_nothing_to_judge(tmp_path) -> None:
    capture = read_capture(write_scene(tmp_path / "s"))
    assert inspect.pose_check(capture).verdict == "n/a"
    assert inspect.coverage_check(capture).verdict == "n/a"


def test_gaps_and_few_views_are_named(posed, monkeypatch) -> None:
    check = inspect.coverage_check(posed)
    assert check.verdict == "warning"  # thirty degrees apart
    assert len(check.views) == 12
    near = tuple(
        dataclasses.replace(view, camera=camera_at(0.2 * k, 0.3, 0)) for k, view in enumerate(posed.views)
    )
    monkeypatch.setattr(inspect.PoseLimits, "few_views", 5)
    assert inspect.coverage_check(dataclasses.replace(posed, views=near)).verdict == "ok"
    far = (*near[:-1], dataclasses.replace(near[-1], camera=camera_at(3.6, 0.3, 0)))
    check = inspect.coverage_check(dataclasses.replace(posed, views=far))
    assert (check.verdict, check.views) == ("warning", ("v11",))


@pytest.mark.parametrize("angle", [0.04, 0.3])
def test_a_turned_camera_of_the_demo_stands_out(whole_demo, angle) -> None:
    capture = read_capture(whole_demo)
    errors = view_errors(epipolar_errors(capture))
    name = min(errors, key=lambda view: errors[view])
    turn = torch.tensor([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    views = []
    for view in capture.views:
        camera = view.camera
        if view.name == name and camera is not None:
            camera = dataclasses.replace(
                camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation
            )
        views.append(dataclasses.replace(view, camera=camera))
    after = view_errors(epipolar_errors(dataclasses.replace(capture, views=tuple(views))))
    assert after[name] > 2.5 * errors[name]


def turned_round(camera: Camera) -> Camera:
    """Turn a camera by 180 degrees about its vertical axis."""
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    return dataclasses.replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)


def test_held_out_views_that_look_elsewhere_are_named(whole_demo) -> None:
    capture = read_capture(whole_demo)
    usual = picture_checks.held_out_check(capture)
    name = capture.test_names[-1]
    turned = tuple(
        dataclasses.replace(view, camera=turned_round(view.camera)) if view.name == name else view
        for view in capture.views
    )
    check = picture_checks.held_out_check(dataclasses.replace(capture, views=turned))
    assert check.verdict == "warning"
    assert check.views[0] == name
    assert check.figures["unseen"][name] > 0.5 > usual.figures["unseen"][name]


def test_held_out_views_between_training_views_are_fine(whole_demo) -> None:
    capture = read_capture(whole_demo)
    middle = sorted(
        picture_checks.held_out_check(capture).figures["unseen"].items(), key=lambda item: item[1]
    )[0][0]
    check = picture_checks.held_out_check(dataclasses.replace(capture, test_names=(middle,)))
    assert (check.verdict, check.views) == ("ok", ())


def test_without_held_out_views_there_is_nothing_to_judge(posed) -> None:
    assert picture_checks.held_out_check(dataclasses.replace(posed, test_names=())).verdict == "n/a"
