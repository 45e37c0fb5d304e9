"""COLMAP models: files, poses, points, and matches by chance."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
from faults import Fault
from tiny_capture import NAMES, TinyCapture

from polarguide.capture import load_scene, read_model
from polarguide.capture.colmap import sfm
from polarguide.capture.colmap.model import load_model, posed_images, unseen_points
from polarguide.capture.colmap.poses import Geometry, Poses
from polarguide.capture.colmap.sfm import connected_views, log_false_alarms, reconstruct
from polarguide.core.progress import SILENT
from polarguide.geometry.camera import Camera
from polarguide.geometry.polarizer import ANGLES


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
    edit(model_folder(capture) / "images.txt", "1 1 0 0 0 ", f"1 {w:.17g} {x:.17g} {y:.17g} {z:.17g} ")
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


@pytest.mark.parametrize(
    ("name", "view"),
    [
        ("my cup (1) é.png", "my cup (1) é"),
        ("0/a b/my cup.JPG", "my cup"),
        ("C:\\\\in\\\\my cup .png", "my cup "),
        ("train/r_0.5", "r_0.5"),
        ("IMG_1.CR2 ", "IMG_1"),
    ],
)
def test_names_of_text_models_are_not_cut(tmp_path: Path, name: str, view: str) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    lines = f"# images\r\n1 1 0 0 0 0 0 0 1 {name}\r\n\r\n2 1e0 0 0 0 0 0 1 1 b.png\r\n1.5 2 -1\r\n"
    (tmp_path / "images.txt").write_bytes(lines.encode())
    found = Poses.read(tmp_path, [view, "b"])
    assert found.views == [view, "b"]
    found.warp(view, Geometry((64, 48), (0, 0), 1, (64, 48)))
    found.write(tmp_path)
    assert set(posed_images(load_model(tmp_path, ".bin"))) == {view, "b"}


@pytest.mark.parametrize(
    ("lines", "found"),
    [
        ("1 1 0 0 0 0 0 0 1 a.png\n2 1 0 0 0 0 0 0 1 b.png\n", "line 2"),  # one line an image
        ("1 1 0 0 0 0 0 0 1 a.png\n\n1 1 0 0 0 0 0 0 1 b.png\n\n", "image 1"),
        ("1 1 0 0 0 0 0 0 1\n\n", "line 1"),
        ("1 1 0 0 0 0 0 0 1 a.png\n1 2\n", "line 2"),
    ],
)
def test_text_models_that_would_be_read_in_part(tmp_path: Path, lines: str, found: str) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (tmp_path / "images.txt").write_text(lines)
    Fault(found=found).raised_by(Poses.read, tmp_path, ["a", "b"])


def test_cameras_without_a_focal_length_are_refused(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 EQUIRECTANGULAR 64 32 64 32\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    Fault("image a.png").raised_by(Poses.read, tmp_path, ["a"])


def test_a_text_model_beside_the_binary_one_is_told(capture: TinyCapture) -> None:
    to_binary(capture)
    assert read_model(capture.root).warnings == ()
    folder = model_folder(capture)
    pycolmap.Reconstruction(str(folder)).write_text(str(folder))
    (warning,) = read_model(capture.root).warnings
    assert warning == f"{folder} has two models. images.bin is used, and images.txt is ignored."


@pytest.mark.parametrize(("name", "old", "new"), [("cameras", ".5", ",5"), ("images", "0.", "0,")])
def test_decimal_commas_of_a_model_are_named(capture: TinyCapture, name: str, old: str, new: str) -> None:
    path = model_folder(capture) / f"{name}.txt"
    path.write_text(path.read_text().replace(old, new))
    Fault(f"{name}.txt", "numbers with a decimal point", "a decimal comma").raised_by(
        read_model, capture.root
    )


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


def broken_binary(name: str, change: Callable[[bytes], bytes]) -> Callable[[TinyCapture], None]:
    """Change a file of the model after it was made binary."""

    def damage(capture: TinyCapture) -> None:
        to_binary(capture)
        path = model_folder(capture) / name
        path.write_bytes(change(path.read_bytes()))

    return damage


def edited(name: str, old: str, new: str) -> Callable[[TinyCapture], None]:
    return lambda capture: edit(model_folder(capture) / name, old, new)


def pose_of_another(capture: TinyCapture) -> None:
    for angle in ANGLES:
        capture.picture("v004", angle).unlink()
    edit(model_folder(capture) / "images.txt", "v004.png", "left/v005.jpg")


NAN = struct.pack("<d", float("nan"))
REFUSED = Fault(
    "sparse/0",
    expected="a readable COLMAP model",
    found="pycolmap cannot read",
    remedy="Export the model again",
)
FAULTS: dict[str, tuple[Callable[[TinyCapture], object], Fault]] = {
    **{
        line.split()[1]: (
            lambda capture, line=line: capture.write_cameras(line),
            Fault("camera 1, image v000.png", "undistorted", line.split()[1], "Undistort"),
        )
        for line in (
            "1 SIMPLE_RADIAL 12 10 15.5 6.5 4.75 0.01",
            "1 OPENCV 12 10 15.5 15 6.5 4.75 0 0 0 -1e-4",
            "1 OPENCV_FISHEYE 12 10 15.5 15 6.5 4.75 0 0 0 0",
        )
    },
    **{
        f"{name} that is none": (
            lambda capture, name=name: (model_folder(capture) / name).write_text("not a model\n"), REFUSED
        )
        for name in ("cameras.txt", "images.txt", "points3D.txt")
    },
    "intrinsics of another shape": (
        lambda capture: capture.write_cameras("1 PINHOLE 13 10 15 15 6 5"),
        Fault("camera of view v000", "the size of the pictures, 12x10", "13x10"),
    ),
    "no model": (
        lambda capture: model_folder(capture).rename(capture.root / "model"),
        Fault("sparse/0", "a COLMAP model", "sparse/", "structure from motion"),
    ),
    "an incomplete model": (
        lambda capture: (model_folder(capture) / "images.txt").unlink(),
        Fault("images.txt", found="nothing", remedy="points3D.txt"),
    ),
    "images cut short": (broken_binary("images.bin", lambda data: data[:20]), Fault("sparse/0")),
    "points cut short": (broken_binary("points3D.bin", lambda data: data[:20]), Fault("sparse/0")),
    "a pose that is no number": (  # with frames.bin, from which the poses are taken
        broken_binary("images.bin", lambda data: data[:12] + NAN + data[20:]),
        Fault("images.bin", found="an image whose pose is not finite"),
    ),
    "no turn": (
        edited("images.txt", "1 1 0 0 0 ", "1 0 0 0 0 "), Fault("image v000.png", "a quaternion of length 1")
    ),
    "a negative focal length": (
        edited("cameras.txt", "PINHOLE 12 10 15.5", "PINHOLE 12 10 -15.5"),
        Fault("image v000.png", "positive focal lengths", "quaternion"),
    ),
    "a principal point far away": (
        edited("cameras.txt", " 6.5 ", " 1e9 "),
        Fault("image v000.png", expected="a principal point, at most 10000 sides")
    ),
    "a tiny focal length": (
        edited("cameras.txt", "15.5 ", "1e-4 "),
        Fault("image v000.png", expected="a principal point, at most 10000 sides")
    ),
    "a camera without pixels": (
        edited("cameras.txt", "PINHOLE 12 10", "PINHOLE 0 0"), Fault("camera of view v000", "12x10", "0x0")
    ),
    "no points": (
        lambda capture: (model_folder(capture) / "points3D.txt").write_text("# none\n"),
        Fault("points3D.txt", "3D points", "none", "Triangulate"),
    ),
    "a picture without a pose": (
        edited("images.txt", "v004.png", "v4.png"),
        Fault("sparse/0", "image called v004", "none; the nearest are", "Register the view"),
    ),
    "two poses of one name": (
        pose_of_another, Fault(expected="one posed image called v005", found="left/v005.jpg, v005.png")
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FAULTS)
def test_each_fault_of_a_model_is_named(capture: TinyCapture, case: str) -> None:
    damage, fault = FAULTS[case]
    damage(capture)
    fault.raised_by(load_scene, capture.root)


def test_intrinsics_of_pictures_that_were_resized_are_scaled(capture: TinyCapture) -> None:
    capture.write_cameras("1 PINHOLE 36 30 45 42 18 15")
    scene = load_scene(capture.root)
    camera = scene.views[0].camera
    assert (camera.width, camera.height) == (12, 10)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((15, 14, 6, 5), abs=1e-12)
    assert len(scene.warnings) == 1
    assert "another resolution (36x30)" in scene.warnings[0]
    assert "scaled in 9 of 9 views (v000, v001, v002, v003 and 5 more)" in scene.warnings[0]


def test_points_that_are_not_finite_are_left_out(capture: TinyCapture) -> None:
    to_binary(capture)
    model = pycolmap.Reconstruction(str(model_folder(capture)))
    model.points3D[3].xyz = np.array([np.nan, 0.0, 0.0])
    model.points3D[4].xyz = np.array([1e300, 0.0, 0.0])
    model.write_binary(str(model_folder(capture)))
    scene = load_scene(capture.root)
    assert scene.points.shape == (2, 3)
    (warning,) = scene.warnings
    assert "2 of 4 3D points" in warning


def test_pose_without_pictures(capture: TinyCapture) -> None:
    for view in ("v002", "v006"):
        for angle in ANGLES:
            capture.picture(view, angle).unlink()
    scene = load_scene(capture.root)
    assert len(scene.views) == 7
    assert scene.warnings == ("The COLMAP model has poses for 2 images without pictures (v002, v006).",)


WIDTH, HEIGHT, COUNT = 64, 48, 80
SIZES = {f"v{k}": (WIDTH, HEIGHT) for k in range(3)}


def write_database(path: Path, true_share: float) -> None:
    """Matches among three pictures of points in space; a share of them is right, the others join random places."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (COUNT, 3)) + [0, 0, 4]
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 80.0, WIDTH, HEIGHT)
    with pycolmap.Database.open(path) as link:
        link.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        link.write_rig(rig, use_rig_id=True)
        for number in (1, 2, 3):
            image = pycolmap.Image(name=f"v{number - 1}.png", camera_id=1, image_id=number)
            link.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=1)
            frame.add_data_id(image.data_id)
            link.write_frame(frame, use_frame_id=True)
            angle = 0.3 * number
            turn = np.array(
                [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
            )
            there = (points - [0, 0, 4]) @ turn.T + [0, 0, 4]
            seen = 80 * there[:, :2] / there[:, 2:] + [WIDTH / 2, HEIGHT / 2]
            wrong = np.arange(COUNT) >= true_share * COUNT
            seen[wrong] = rng.uniform(0, (WIDTH, HEIGHT), (wrong.sum(), 2))
            link.write_keypoints(number, seen.astype(np.float32))
        pairs = ((1, 2), (1, 3), (2, 3))
        for pair in pairs:
            link.write_matches(*pair, np.stack([np.arange(COUNT, dtype=np.uint32)] * 2, axis=1))
    listed = path.with_name("pairs.txt")
    listed.write_text("".join(f"v{a - 1}.png v{b - 1}.png\n" for a, b in pairs))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    pycolmap.verify_matches(path, listed, options=options)


@pytest.mark.parametrize(("share", "connected"), [(1.0, 3), (0.8, 3), (0.0, 1)])
def test_pairs_connect_views_where_they_agree_better_than_by_chance(
    tmp_path: Path, share: float, connected: int
) -> None:
    write_database(tmp_path / "database.db", share)
    with pycolmap.Database.open(tmp_path / "database.db") as link:
        geometries = link.read_two_view_geometries()[1]
    assert all(len(geometry.inlier_matches) >= 15 for geometry in geometries)  # COLMAP takes all three pairs
    assert connected_views(tmp_path / "database.db", SIZES) == connected


def test_a_model_of_wrong_matches_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = SimpleNamespace(num_reg_images=lambda: 3)
    monkeypatch.setattr(sfm, "match_features", lambda database, *_, **__: write_database(database, 0.0))
    monkeypatch.setattr(sfm, "_map", lambda *_, **__: [model])
    Fault(found="3 of 3 views registered, by matches that agree no better").raised_by(
        reconstruct, tmp_path, SIZES, matching="exhaustive", seed=0, reporter=SILENT, untried=""
    )
    assert not (tmp_path / "model").exists()


def test_false_alarms_become_fewer_with_every_match_that_agrees() -> None:
    numbers = [log_false_alarms(100, agreeing, 0.1) for agreeing in range(8, 101)]
    assert log_false_alarms(100, 7, 0.1) == math.inf
    assert numbers[0] > 0 > numbers[-1]
    # All agree: one choice of them, and of seven of them, to the power of the other 93.
    assert numbers[-1] == pytest.approx(math.log(93) + math.log(math.comb(100, 7)) + 93 * math.log(0.1))


STILL = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
CAMERA = Camera(24, 20, 30.0, 30.0, 12.0, 10.0, *STILL)


def test_one_point_in_one_picture_is_enough() -> None:
    assert unseen_points(torch.tensor([[0.0, 0.0, -5.0], [0.1, 0.0, 3.0]]), [CAMERA]) == []


def test_points_behind_or_far_beside_are_named() -> None:
    for points in ([[0.0, 0.0, -5.0]], [[500.0, 0.0, 1.0]]):
        (warning,) = unseen_points(torch.tensor(points), [CAMERA, CAMERA])
        assert "None of the 1 points" in warning


def test_nothing_is_said_of_nothing() -> None:
    assert unseen_points(torch.zeros(0, 3), [CAMERA]) == unseen_points(torch.ones(1, 3), []) == []
