"""Scenes of arrays in memory are those of the same pictures in files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from trainings import different

import polarguide
from polarguide.capture import Scene, load_scene
from polarguide.core.options import SessionOptions
from polarguide.geometry.camera import Camera
from polarguide.runs.folder import CHECKPOINT

ANGLES = (0, 45, 90, 135)


def stack_of(folder: Path, name: str, angles: tuple[int, ...] = ANGLES) -> np.ndarray:
    """The stored pictures of a view, [K, H, W, 3] RGB."""
    paths = [folder / "polar" / f"{name}_{angle:03d}.png" for angle in angles]
    return np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1] for path in paths])


@pytest.fixture(scope="module")
def filed(demo_scene: Path) -> Scene:
    return load_scene(demo_scene, downscale=4)


def arrays_of(folder: Path, **changes: Any) -> dict[str, Any]:
    """What ``from_arrays`` takes for a scene folder."""
    whole = load_scene(folder)
    return {
        "pictures": {view.name: stack_of(folder, view.name) for view in whole.views},
        "cameras": {view.name: view.camera for view in whole.views},
        "points": whole.points,
        "point_colors": whole.point_colors,
        "test_views": whole.test_names,
        "downscale": 4,
        **changes,
    }


def test_a_scene_of_arrays_is_that_of_its_files(demo_scene: Path, filed: Scene) -> None:
    scene = Scene.from_arrays(**arrays_of(demo_scene))
    assert [view.name for view in scene.views] == [view.name for view in filed.views]
    assert (scene.test_names, scene.downscale, scene.warnings) == (filed.test_names, 4, filed.warnings)
    assert torch.equal(scene.points, filed.points)
    for made, read in zip(scene.views, filed.views, strict=True):
        assert (made.exposures, made.camera.fx, made.camera.width) == (
            read.exposures,
            read.camera.fx,
            read.camera.width,
        )
        for name in ("codes", "invalid", "saturated"):
            assert torch.equal(getattr(made, name), getattr(read, name)), name


def test_it_trains_to_the_same_bits(demo_scene: Path, filed: Scene, tmp_path: Path) -> None:
    scene = Scene.from_arrays(
        **arrays_of(
            demo_scene,
            pictures={v.name: torch.from_numpy(stack_of(demo_scene, v.name).copy()) for v in filed.views},
        ),
        refractive_index=filed.refractive_index,
    )
    settings, session = polarguide.TrainSettings(12, seed=1), SessionOptions(threads=1)
    for out, each in (("arrays", scene), ("files", filed)):
        polarguide.train(each, tmp_path / out, settings=settings, session=session)
    assert different(tmp_path / "arrays" / CHECKPOINT, tmp_path / "files" / CHECKPOINT) == []
    Fault("scene", found="none").raised_by(lambda: polarguide.open_run(tmp_path / "arrays").scene)
    opened = polarguide.open_run(tmp_path / "arrays", scene=scene)
    assert opened.render("v000")["final"].shape == (24, 32, 3)


@pytest.mark.parametrize(
    ("change", "angles"),
    [
        (lambda s: s, ANGLES),
        (lambda s: s.astype(np.float32) / 65535, ANGLES),
        (lambda s: s[[2, 0, 3, 1]], (90, 0, 135, -135)),
        (lambda s: torch.from_numpy(s.copy()), ANGLES),
    ],
    ids=["uint16", "floats", "another order", "torch"],
)
def test_types_and_orders(
    demo_scene: Path, change: Callable[[np.ndarray], Any], angles: tuple[float, ...]
) -> None:
    whole = load_scene(demo_scene, views=["v000", "v001"])
    scene = Scene.from_arrays(
        [change(stack_of(demo_scene, view.name)) for view in whole.views],
        [view.camera for view in whole.views],
        angles,
        points=whole.points.numpy(),
    )
    for made, read in zip(scene.views, whole.views, strict=True):
        assert torch.equal(made.codes, read.codes)
    assert [view.name for view in scene.views] == ["v000", "v001"]


CAMERA = Camera.from_matrices(np.diag([50.0, 50.0, 1.0]) + np.eye(3, k=2) * 4, np.eye(4), 8, 6)
GOOD = np.full((4, 6, 8), 100, np.uint8)


@pytest.mark.parametrize(
    ("changes", "where", "found"),
    [
        ({"pictures": [GOOD[0], GOOD]}, "pictures (v000)", "uint8 of shape [6, 8]"),
        ({"pictures": [GOOD.astype(np.int64), GOOD]}, "pictures (v000)", "int64 of shape [4, 6, 8, 1]"),
        ({"pictures": [GOOD / 50, GOOD]}, "pictures (v000)", "2 to 2"),
        ({"pictures": [GOOD * np.nan, GOOD]}, "pictures (v000)", "nan to nan"),
        (
            {"pictures": [GOOD, GOOD.astype(np.uint16)]},
            "pictures",
            "8 bits in view v000 and 16 bits in view v001",
        ),
        ({"pictures": []}, "pictures", "0"),
        ({"angles": (0, 45, 90)}, "angles (v000)", "3"),
        ({"angles": (0, 45, 90, "left")}, "angles (v000)", "'left'"),
        ({"cameras": [CAMERA]}, "cameras", "1"),
        ({"cameras": [np.eye(4), CAMERA]}, "cameras (v000)", "ndarray"),
        ({"pictures": [GOOD[:, :5], GOOD]}, "cameras (v000)", "8x6"),
        ({"masks": [np.ones((5, 8), bool)] * 2}, "masks (v000)", "bool of shape [5, 8]"),
        ({"masks": {"v000": np.ones((6, 8), bool), "cup": None}}, "masks", "others: cup, v000"),
        ({"points": np.zeros((0, 3))}, "points", "float64 of shape [0, 3]"),
        ({"point_colors": np.zeros((2, 3), np.uint8)}, "point_colors", "2"),
        ({"test_views": ["v009"]}, "test_views", "'v009'"),
        ({"downscale": 7}, "downscale", "7"),
        (
            {"pictures": [GOOD / 100, GOOD / 100], "transfer": "srgb"},
            "pictures (v000)",
            "floats",
        ),
    ],
)
def test_wrong_arrays_are_refused_in_one_line(changes: dict[str, Any], where: str, found: str) -> None:
    given = {"pictures": [GOOD, GOOD], "cameras": [CAMERA, CAMERA], "points": np.ones((1, 3))} | changes
    Fault(where, found=found).raised_by(Scene.from_arrays, **given)


@pytest.mark.parametrize(
    ("intrinsics", "pose"),
    [
        (np.eye(4), np.eye(4)),
        (np.eye(3), np.eye(3)),
        (np.eye(3), np.diag([1.0, 1.0, -1.0, 1.0])),
        (np.eye(3), np.full((4, 4), np.nan)),
        (np.diag([-5.0, 5.0, 1.0]), np.eye(4)),
        (np.eye(3) + np.eye(3, k=1), np.eye(4)),
    ],
)
def test_matrices_that_are_no_camera_are_refused(intrinsics: np.ndarray, pose: np.ndarray) -> None:
    Fault("camera").raised_by(Camera.from_matrices, intrinsics, pose, 8, 6)


def test_representations_are_two_lines_and_html(filed: Scene) -> None:
    for each in (filed, filed.views[0]):
        lines = repr(each).splitlines()
        assert len(lines) == 2
        assert max(map(len, lines)) < 120
        assert each._repr_html_().count("<img") == (5 if each is filed else 1)
    assert "14 views of 32x24 pixels" in repr(filed)
    assert "4 pictures (0, 45, 90, 135)" in repr(filed.views[0])
