"""COLMAP models: text and binary, pinholes under other names, and what cannot be used."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from tiny_capture import NAMES, TinyCapture

from polarguide.capture import load_scene, read_model
from polarguide.errors import PolarguideError
from polarguide.polarizer import ANGLES


def model_folder(capture: TinyCapture) -> Path:
    return capture.root / "sparse" / "0"


def to_binary(capture: TinyCapture) -> None:
    """Replace the text model by a binary one that COLMAP's own code writes."""
    folder = model_folder(capture)
    model = pycolmap.Reconstruction(str(folder))
    for path in folder.iterdir():
        path.unlink()
    model.write_binary(str(folder))


def edit(path: Path, old: str, new: str, *, count: int = 1) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def fails(root: Path, *parts: str) -> None:
    """``load_scene`` raises one error whose message holds all parts, in order."""
    with pytest.raises(PolarguideError, match=".*".join(re.escape(part) for part in parts)):
        load_scene(root)


def test_binary_and_text_models_read_the_same(capture: TinyCapture) -> None:
    text = load_scene(capture.root)
    to_binary(capture)
    binary = load_scene(capture.root)
    assert torch.equal(text.points, binary.points)
    assert torch.equal(text.point_colors, binary.point_colors)
    for one, other in zip(text.views, binary.views, strict=True):
        torch.testing.assert_close(one.camera.rotation, other.camera.rotation, atol=1e-15, rtol=0)
        assert torch.equal(one.camera.translation, other.camera.translation)
        assert (one.camera.fx, one.camera.cy) == (other.camera.fx, other.camera.cy)
    assert text.digest != binary.digest


def test_rotations_agree_with_the_quaternion_formula(capture: TinyCapture) -> None:
    quaternion = np.array([0.4, -0.1, 0.7, 0.2])
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    path = model_folder(capture) / "images.txt"
    edit(path, "1 1 0 0 0 ", f"1 {w:.17g} {x:.17g} {y:.17g} {z:.17g} ")
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    expected = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    np.testing.assert_allclose(
        load_scene(capture.root).views[0].camera.rotation.numpy(), expected, atol=1e-14
    )


def test_model_directly_under_sparse(capture: TinyCapture) -> None:
    folder = model_folder(capture)
    for path in folder.iterdir():
        path.rename(folder.parent / path.name)
    folder.rmdir()
    assert read_model(capture.root).names == list(NAMES)


def test_binary_wins_over_text(capture: TinyCapture) -> None:
    text = {path.name: path.read_text() for path in model_folder(capture).iterdir()}
    to_binary(capture)
    for name, content in text.items():
        (model_folder(capture) / name).write_text(content)
    capture.write_cameras("1 PINHOLE 12 10 99 99 6 5")
    assert load_scene(capture.root).views[0].camera.fx == 15.5
    assert {path.suffix for path in read_model(capture.root).files} == {".bin"}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1 SIMPLE_PINHOLE 12 10 15.5 6.5 4.75", (15.5, 15.5, 6.5, 4.75)),
        ("1 SIMPLE_RADIAL 12 10 15.5 6.5 4.75 0", (15.5, 15.5, 6.5, 4.75)),
        ("1 RADIAL 12 10 15.5 6.5 4.75 0 0", (15.5, 15.5, 6.5, 4.75)),
        ("1 OPENCV 12 10 15.5 15 6.5 4.75 0 0 0 0", (15.5, 15.0, 6.5, 4.75)),
        ("1 FULL_OPENCV 12 10 15.5 15 6.5 4.75 0 0 0 0 0 0 0 0", (15.5, 15.0, 6.5, 4.75)),
    ],
)
def test_models_without_distortion_are_pinholes(
    capture: TinyCapture, line: str, expected: tuple[float, ...]
) -> None:
    capture.write_cameras(line)
    camera = load_scene(capture.root).views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == expected


@pytest.mark.parametrize(
    "line",
    [
        "1 SIMPLE_RADIAL 12 10 15.5 6.5 4.75 0.01",
        "1 OPENCV 12 10 15.5 15 6.5 4.75 0 0 0 -1e-4",
        "1 OPENCV_FISHEYE 12 10 15.5 15 6.5 4.75 0 0 0 0",
    ],
)
def test_distortion_is_refused(capture: TinyCapture, line: str) -> None:
    capture.write_cameras(line)
    fails(capture.root, "camera 1, image v000.png", "undistorted", f"found {line.split()[1]}", "Undistort")


def test_intrinsics_of_pictures_that_were_resized_are_scaled(capture: TinyCapture) -> None:
    capture.write_cameras("1 PINHOLE 36 30 45 42 18 15")
    scene = load_scene(capture.root)
    camera = scene.views[0].camera
    assert (camera.width, camera.height) == (12, 10)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((15, 14, 6, 5), abs=1e-12)
    assert len(scene.warnings) == 1
    assert "another resolution (36x30)" in scene.warnings[0]
    assert "scaled in 9 of 9 views (v000, v001, v002, v003 and 5 more)" in scene.warnings[0]


def test_intrinsics_of_another_shape_are_refused(capture: TinyCapture) -> None:
    capture.write_cameras("1 PINHOLE 13 10 15 15 6 5")
    fails(capture.root, "camera of view v000", "the size of the pictures, 12x10", "found 13x10")


def test_no_model(capture: TinyCapture) -> None:
    model_folder(capture).rename(capture.root / "model")
    fails(
        capture.root,
        "sparse/0",
        "a COLMAP model",
        "found neither there nor in sparse/",
        "structure from motion",
    )


def test_incomplete_model(capture: TinyCapture) -> None:
    (model_folder(capture) / "images.txt").unlink()
    fails(capture.root, "images.txt", "found nothing", "cameras.txt, images.txt and points3D.txt together")


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
def test_broken_text_model(capture: TinyCapture, name: str) -> None:
    (model_folder(capture) / name).write_text("not a model\n")
    fails(capture.root, "sparse/0", "a readable COLMAP model", "pycolmap refuses", "Export the model again")


@pytest.mark.parametrize("name", ["images.bin", "points3D.bin"])
def test_binary_model_cut_short(capture: TinyCapture, name: str) -> None:
    to_binary(capture)
    path = model_folder(capture) / name
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(PolarguideError, match="sparse/0"):
        load_scene(capture.root)


@pytest.mark.parametrize(
    ("old", "new"), [("1 1 0 0 0 ", "1 0 0 0 0 "), ("PINHOLE 12 10 15.5", "PINHOLE 12 10 -15.5")]
)
def test_broken_numbers(capture: TinyCapture, old: str, new: str) -> None:
    for name in ("images.txt", "cameras.txt"):
        path = model_folder(capture) / name
        if old in path.read_text():
            edit(path, old, new)
    fails(capture.root, "image v000.png", "a unit quaternion", "positive focal lengths", "found quaternion")


@pytest.mark.parametrize(("old", "new"), [(" 6.5 ", " 1e9 "), ("15.5 ", "1e-4 ")])
def test_a_lens_that_no_camera_has(capture: TinyCapture, old: str, new: str) -> None:
    edit(model_folder(capture) / "cameras.txt", old, new)
    fails(capture.root, "image v000.png", "a principal point, at most 10000 sides of the picture away")


def test_a_camera_without_pixels(capture: TinyCapture) -> None:
    edit(model_folder(capture) / "cameras.txt", "PINHOLE 12 10", "PINHOLE 0 0")
    fails(capture.root, "camera of view v000", "12x10", "found 0x0")


def test_a_pose_that_is_no_number_in_images_bin(capture: TinyCapture) -> None:
    to_binary(capture)  # with frames.bin, from which the poses are taken
    path = model_folder(capture) / "images.bin"
    data = path.read_bytes()
    path.write_bytes(data[:12] + struct.pack("<d", float("nan")) + data[20:])
    fails(capture.root, "images.bin", "an image whose pose is not finite")


def test_no_points(capture: TinyCapture) -> None:
    (model_folder(capture) / "points3D.txt").write_text("# none\n")
    fails(capture.root, "points3D.txt", "3D points", "found none", "Triangulate")


def test_points_that_are_not_finite_are_left_out(capture: TinyCapture) -> None:
    model = pycolmap.Reconstruction(str(model_folder(capture)))
    model.points3D[3].xyz = np.array([np.nan, 0.0, 0.0])
    model.points3D[4].xyz = np.array([1e300, 0.0, 0.0])
    model.write_binary(str(model_folder(capture)))
    scene = load_scene(capture.root)
    assert scene.points.shape == (2, 3)
    assert scene.warnings == ("2 of 4 3D points are not finite, or farther than 1e+09, and were left out.",)


def test_picture_without_a_pose(capture: TinyCapture) -> None:
    edit(model_folder(capture) / "images.txt", "v004.png", "v4.png")
    fails(capture.root, "sparse/0", "image called v004", "found none; the nearest are", "Register the view")


def test_two_poses_of_one_name(capture: TinyCapture) -> None:
    for angle in ANGLES:
        capture.picture("v004", angle).unlink()
    edit(model_folder(capture) / "images.txt", "v004.png", "left/v005.jpg")
    fails(capture.root, "one posed image called v005", "found left/v005.jpg, v005.png")


def test_pose_without_pictures(capture: TinyCapture) -> None:
    for view in ("v002", "v006"):
        for angle in ANGLES:
            capture.picture(view, angle).unlink()
    scene = load_scene(capture.root)
    assert len(scene.views) == 7
    assert scene.warnings == ("The COLMAP model has poses for 2 images without pictures (v002, v006).",)
