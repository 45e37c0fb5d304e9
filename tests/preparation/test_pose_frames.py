"""Poses from outside and EXIF orientation: whether they are of the stored or of the displayed pixels."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_files import (
    ANGLES,
    behind,
    read_mask,
    read_polar,
    smooth_light,
    write_model,
    write_picture,
    write_shots,
)
from heard import Heard
from test_prepare_filter import with_orientation

from polarguide.capture import load_scene
from polarguide.capture.calibration import apply_orientation
from polarguide.capture.colmap.model import PosedCamera
from polarguide.capture.colmap.poses import Geometry, Poses
from polarguide.preparation.open_source import known_poses, settle_pose_frames
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide.preparation.source import Source, Stored

SETTINGS = PrepareSettings(gains="none", align=False, transfer="linear")
NAMES = ("v000", "v001", "v002")


def write_turned(folder: Path, code: int, size: tuple[int, int]) -> np.ndarray:
    """Shots with an orientation tag; returns the light as stored, [3, H, W, 3]."""
    light = smooth_light(size[1], size[0])
    for name in NAMES:
        write_shots(folder, name, behind(light), suffix=".jpg", bits=8)
        for angle in ANGLES:
            with_orientation(folder / str(angle) / f"{name}.jpg", code)
    return light


def displayed(light: np.ndarray, code: int) -> np.ndarray:
    """Stokes vectors of the picture as it is displayed."""
    turned = np.stack([apply_orientation(plane, code) for plane in light])
    turned[1:] *= -1.0 if code in (5, 6, 7, 8) else 1.0
    turned[2] *= -1.0 if code in (2, 4, 5, 7) else 1.0
    return turned


@pytest.mark.parametrize(
    ("code", "size", "camera", "asked", "as_stored"),
    [
        (3, (128, 96), "PINHOLE 128 96 110 112 61 50", "auto", True),
        (2, (128, 96), "PINHOLE 128 96 110 112 61 50", "auto", True),
        (3, (128, 96), "PINHOLE 128 96 110 112 61 50", "displayed", False),
        (6, (128, 96), "PINHOLE 128 96 110 112 61 50", "auto", True),
        (8, (128, 96), "PINHOLE 64 48 55 56 30.5 25", "auto", True),  # of pictures of half the size
        (6, (128, 96), "PINHOLE 96 128 112 110 46 61", "auto", False),
        (6, (96, 96), "PINHOLE 96 96 110 112 46 50", "auto", True),
        (6, (96, 96), "PINHOLE 96 96 110 112 46 50", "displayed", False),
    ],
)
def test_pictures_are_those_that_the_poses_are_of(
    tmp_path: Path, code: int, size: tuple[int, int], camera: str, asked: str, as_stored: bool
) -> None:
    light = write_turned(tmp_path / "in", code, size)
    model = write_model(tmp_path / "model", NAMES, camera)
    heard = Heard()
    settings = replace(SETTINGS, poses=str(model), poses_of=asked)
    prepare_scene(tmp_path / "in", tmp_path / "out", settings, heard)
    expected = behind(light if as_stored else displayed(light, code))
    assert np.abs(read_polar(tmp_path / "out", "v001") - expected).max() < 0.03
    found = load_scene(tmp_path / "out").views[0].camera
    numbers = [float(number) for number in camera.split()[1:]]
    larger = found.width / numbers[0]
    inner = (found.width, found.height, found.fx, found.fy, found.cx, found.cy)
    assert inner == pytest.approx([larger * number for number in numbers])
    (line,) = [text for text in heard.said if text.startswith("EXIF orientation of 3 of 3 views")]
    assert f"--poses-of {'displayed' if as_stored else 'stored'}" in line


@pytest.mark.parametrize("code", [5, 6, 8])
@pytest.mark.parametrize("as_stored", [True, False])
@pytest.mark.parametrize("mask_as_stored", [True, False])
def test_masks_follow_their_pictures(
    tmp_path: Path, code: int, as_stored: bool, mask_as_stored: bool
) -> None:
    """Masks of displayed pictures beside pictures as stored, and the reverse: by their size."""
    write_turned(tmp_path / "in", code, (128, 96))
    mask = np.zeros((96, 128), bool)
    mask[10:40, 20:90] = True
    drawn = mask if mask_as_stored else apply_orientation(mask, code)
    for name in NAMES:
        write_picture(tmp_path / "masks" / f"{name}.png", drawn.astype(float), bits=8)
    model = write_model(tmp_path / "model", NAMES, "PINHOLE 128 96 110 112 61 50")
    poses = str(model) if as_stored else "none"
    settings = replace(SETTINGS, poses=poses, masks=str(tmp_path / "masks"))
    prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    expected = mask if as_stored else apply_orientation(mask, code)
    assert (read_mask(tmp_path / "out", "v001") == expected).all()


@pytest.mark.parametrize(
    ("lens", "asked", "size", "reason"),
    [
        ({"camera_angle_x": 1.0}, "auto", (128, 96), "convention of COLMAP"),
        ({"camera_angle_x": 1.0}, "displayed", (96, 128), "according to --poses-of"),
        ({"fl_x": 100.0, "cx": 47.0, "cy": 65.0}, "auto", (96, 128), "according to the sizes"),
        ({"fl_x": 100.0, "cx": 65.0, "cy": 47.0}, "auto", (128, 96), "according to the sizes"),
    ],
)
def test_cameras_without_a_size_get_that_of_the_pixels_they_are_of(
    tmp_path: Path, lens: dict, asked: str, size: tuple[int, int], reason: str
) -> None:
    frame = {"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "t.json").write_text(json.dumps({**lens, "frames": [frame, {**frame, "file_path": "x.jpg"}]}))
    source = Tagged({"a": 6})
    source.views = ["a"]
    poses = known_poses(tmp_path, source, str(tmp_path / "t.json"), asked)
    assert poses is not None
    line = settle_pose_frames(source, poses, asked)
    assert reason in line
    (camera,) = poses.developed({"a": Geometry(size, (0, 0), 1, size)}).values()
    assert (camera.width, camera.height) == size
    assert source.as_stored == ({"a"} if size == (128, 96) else set())


class Tagged(Source):
    """Pictures of 128x96 with orientation tags."""

    def __init__(self, codes: dict[str, int]) -> None:
        self._codes = codes

    def stored(self, view: str) -> Stored:
        return Stored((128, 96), self._codes[view])


@pytest.mark.parametrize(
    ("codes", "sizes", "kept"),
    [
        # A view whose size tells decides for those whose sizes do not.
        ({"a": 6, "b": 3}, {"a": (96, 128), "b": (128, 96)}, set()),
        ({"a": 6, "b": 3}, {"a": (128, 96), "b": (128, 96)}, {"a", "b"}),
        ({"a": 6, "b": 8, "c": 3}, {"a": (96, 128), "b": (128, 96), "c": (128, 96)}, {"b", "c"}),
        ({"a": 1, "b": 3}, {"a": (128, 96), "b": (128, 96)}, {"b"}),
        ({"a": 1, "b": 1}, {"a": (128, 96), "b": (128, 96)}, set()),
    ],
)
def test_views_decide_for_one_another(
    codes: dict[str, int], sizes: dict[str, tuple[int, int]], kept: set[str]
) -> None:
    cameras = {
        view: PosedCamera(*size, "PINHOLE", (100.0, 100.0, 50.0, 50.0), np.eye(3), np.array([0.0, 0, k]))
        for k, (view, size) in enumerate(sizes.items())
    }
    source = Tagged(codes)
    line = settle_pose_frames(source, Poses.of_cameras(cameras, Path("m"), sorted(cameras)), "auto")
    assert source.as_stored == kept
    assert bool(line) == any(code != 1 for code in codes.values())
