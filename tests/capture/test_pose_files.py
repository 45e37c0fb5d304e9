"""Poses of other programs: nerfstudio, Metashape, IDR. Projections are compared with their own formulas."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from dataset_files import HEIGHT, INNER, WIDTH, idr_cameras, poses
from faults import Fault

from polarguide.capture.colmap.model import colmap_camera
from polarguide.capture.pose_files import read_pose_file
from polarguide.core.errors import PolarguideWarning
from polarguide.geometry.camera import Camera
from polarguide.results.export.placement import write_transforms

VIEWS = ["a", "b", "c", "d"]
Sizes = tuple[tuple[int, int], ...]


def unknown(view: str) -> Sizes:
    return ()


def stated(view: str) -> Sizes:
    return ((WIDTH, HEIGHT),)


LENS = {
    "f": 90.0,
    "cx": 1.5,
    "cy": -2.25,
    "b1": 0.7,
    "k1": 0.06,
    "k2": -0.03,
    "k3": 0.02,
    "p1": 0.002,
    "p2": -0.001,
}


def write_metashape(
    path: Path, lens: dict[str, float], labels: list[str], more: str = "", kind: str = "frame"
) -> None:
    values = "".join(f"<{name}>{value!r}</{name}>" for name, value in lens.items())
    cameras = ""
    for label, (rotation, translation) in zip(labels, poses(), strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ translation
        numbers = " ".join(repr(float(number)) for number in matrix.ravel())
        cameras += f'<camera id="0" sensor_id="0" label="{label}"><transform>{numbers}</transform></camera>'
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1"><sensors>'
        f'<sensor id="0" label="x" type="{kind}"><resolution width="{WIDTH}" height="{HEIGHT}"/>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>{values}'
        f"</calibration></sensor></sensors><cameras>{cameras}"
        f'<camera id="9" sensor_id="0" label="unaligned"/>{more}</cameras></chunk></document>'
    )


@pytest.mark.parametrize("kind", ["frame", "fisheye", "equidistant_fisheye"])
def test_metashape_projects_as_its_manual_says(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "cameras.xml"
    k4 = 0.0 if kind == "frame" else -0.01
    write_metashape(path, LENS | {"k4": k4}, ["a.JPG", "b.JPG", "c.JPG", "d.JPG"], kind=kind)
    found = read_pose_file(path, VIEWS, unknown)
    assert sorted(found) == VIEWS
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))
    for view, (rotation, translation) in zip(VIEWS, poses(), strict=True):
        local = points @ rotation.T + translation
        x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
        if kind != "frame":
            x, y = np.stack([x, y]) * np.arctan(np.hypot(x, y)) / np.hypot(x, y)
        r2 = x * x + y * y
        bend = 1 + LENS["k1"] * r2 + LENS["k2"] * r2**2 + LENS["k3"] * r2**3 + k4 * r2**4
        xd = x * bend + LENS["p1"] * (r2 + 2 * x * x) + 2 * LENS["p2"] * x * y
        yd = y * bend + LENS["p2"] * (r2 + 2 * y * y) + 2 * LENS["p1"] * x * y
        u = WIDTH * 0.5 + LENS["cx"] + xd * LENS["f"] + xd * LENS["b1"]
        v = HEIGHT * 0.5 + LENS["cy"] + yd * LENS["f"]
        camera = found[view]
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-9)
        seen = colmap_camera(camera).img_from_cam(points @ camera.rotation.T + camera.translation)
        np.testing.assert_allclose(seen, np.stack([u, v], axis=1), atol=1e-6)


def test_nerfstudio_reads_what_export_writes(tmp_path: Path) -> None:
    import torch

    path = tmp_path / "transforms.json"
    cameras = {
        view: Camera(WIDTH, HEIGHT, 90.0, 92.0, 33.0, 23.0, torch.from_numpy(r), torch.from_numpy(t))
        for view, (r, t) in zip(VIEWS, poses(), strict=True)
    }
    write_transforms(path, cameras)
    for view, (rotation, translation) in zip(VIEWS, poses(), strict=True):
        camera = read_pose_file(path, VIEWS, unknown)[view]
        assert (camera.model, camera.width, camera.height) == ("PINHOLE", WIDTH, HEIGHT)
        assert camera.parameters == pytest.approx((90, 92, 33, 23))
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-9)
        np.testing.assert_allclose(camera.translation, translation, atol=1e-9)


def test_nerfstudio_with_one_lens_for_all_frames(tmp_path: Path) -> None:
    lens = {"camera_angle_x": 2 * math.atan(WIDTH / 2 / 90), "w": WIDTH, "h": HEIGHT, "k1": 0.01, "p2": 0.002}
    frames = [{"file_path": f"./images/{v}.jpg", "transform_matrix": np.eye(4).tolist()} for v in VIEWS]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**lens, "frames": frames}))
    camera = read_pose_file(path, VIEWS, unknown)["b"]
    assert camera.model == "FULL_OPENCV"
    expected = (90, 90, WIDTH / 2, HEIGHT / 2, 0.01, 0, 0, 0.002, 0, 0, 0, 0)
    assert camera.parameters == pytest.approx(expected)


def test_idr_cameras_belong_to_views_by_number_or_in_order(tmp_path: Path) -> None:
    path = tmp_path / "cameras_new.npz"
    np.savez(path, **idr_cameras())
    for views in (["0", "1", "2", "3"], VIEWS):
        found = read_pose_file(path, views, stated)
        for view, (rotation, _) in zip(views, poses(), strict=True):
            np.testing.assert_allclose(found[view].rotation, rotation, atol=1e-6)
            assert found[view].parameters == pytest.approx((INNER[0, 0], INNER[1, 1], 33, 23))
    Fault(expected="as many cameras as views, 3").raised_by(read_pose_file, path, VIEWS[:3], stated)


FOCAL = {"fl_x": 90.0, "fl_y": 92.0}
MATRIX = [[90.0, -1e-4, 33.0], [0.0, 92.0, 23.0], [0.0, 0.0, 1.0]]
WHOLE = {**FOCAL, "cx": 33.0, "cy": 23.0, "w": WIDTH, "h": HEIGHT}
ANGLE = 2 * math.atan(WIDTH / 2 / 90)


def write_json(path: Path, top: dict, frame: dict | None = None) -> Path:
    """A transforms.json of all poses."""
    frames = []
    for view, (rotation, translation) in zip(VIEWS, poses(), strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ translation
        if not top.get("from_na"):
            matrix[:3, 1:3] *= -1
        frames.append({"file_path": f"./train/{view}", "transform_matrix": matrix.tolist(), **(frame or {})})
    path.write_text(json.dumps({**top, "frames": frames}))
    return path


@pytest.mark.parametrize(
    ("top", "frame", "model", "parameters"),
    [
        # nerfstudio's k1, k2, k3, k4, p1, p2, for all frames or in one
        ({**WHOLE, "distortion_params": [0.1, 0.2, 0.3, 0, 0.01, 0.02]}, {}, "FULL_OPENCV",
         (90, 92, 33, 23, 0.1, 0.2, 0.01, 0.02, 0.3, 0, 0, 0)),
        (WHOLE, {"distortion_params": [0.1, 0, 0, 0, 0, 0]}, "FULL_OPENCV", (90, 92, 33, 23, 0.1, *[0] * 7)),
        (WHOLE, {"fl_x": 80.0, "fl_y": 81.0}, "PINHOLE", (80, 81, 33, 23)),
        # what a frame says of focal length or distortion takes the place of all that the file says
        ({**WHOLE, "camera_angle_x": ANGLE, "k1": 0.3, "k2": 0.1},
         {"fl_x": 80.0, "distortion_params": [0.1, 0, 0, 0, 0, 0]}, "FULL_OPENCV", (80, 80, 33, 23, 0.1, *[0] * 7)),
        ({**WHOLE, "camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, {}, "OPENCV_FISHEYE",
         (90, 92, 33, 23, 0.1, 0, 0, 0.4)),
        ({**WHOLE, "is_fisheye": True, "k1": 0.1}, {}, "OPENCV_FISHEYE", (90, 92, 33, 23, 0.1, 0, 0, 0)),
        # Blender states an angle alone, instant-ngp degrees; the pictures state the size
        ({"camera_angle_x": ANGLE}, {}, "PINHOLE", (90, 90, WIDTH / 2, HEIGHT / 2)),
        ({"x_fov": math.degrees(ANGLE), "y_fov": 30.0}, {}, "PINHOLE",
         (90, HEIGHT / 2 / math.tan(math.radians(15)), WIDTH / 2, HEIGHT / 2)),
        ({**FOCAL, "cx": 33.0, "cy": 23.0, "aabb_scale": 16}, {}, "PINHOLE", (90, 92, 33, 23)),
        (WHOLE, {"transform_matrix_start": None, "sharpness": 3.0}, "PINHOLE", (90, 92, 33, 23)),
        # NeuS2, with other axes, and in those of instant-ngp
        ({"from_na": True, "w": WIDTH, "h": HEIGHT}, {"intrinsic_matrix": MATRIX}, "PINHOLE", (90, 92, 33, 23)),
        ({"w": WIDTH, "h": HEIGHT}, {"intrinsic_matrix": MATRIX}, "PINHOLE", (90, 92, 33, 23)),
    ],
)  # fmt: skip
def test_every_field_of_transforms_is_used(
    tmp_path: Path, top: dict, frame: dict, model: str, parameters: tuple[float, ...]
) -> None:
    found = read_pose_file(write_json(tmp_path / "t.json", top, frame), VIEWS, stated)
    for view, (rotation, translation) in zip(VIEWS, poses(), strict=True):
        camera = found[view]
        assert (camera.model, camera.width, camera.height) == (model, WIDTH, HEIGHT)
        assert camera.parameters == pytest.approx(parameters)
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-9)
        np.testing.assert_allclose(camera.translation, translation, atol=1e-9)


@pytest.mark.parametrize(
    ("top", "frame", "found"),
    [
        ({"k4": 0.1}, {}, "k4"),
        ({"k5": 0.1}, {}, "k5"),
        ({"distortion_params": [0.1] * 12}, {}, "12 numbers"),
        ({"distortion_params": [0.1, 0, 0, 0, 0, 0], "k1": 0.2}, {}, "0.2"),
        ({"camera_model": "EQUIRECTANGULAR"}, {}, "EQUIRECTANGULAR"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, {}, "OPENCV with is_fisheye"),
        ({"is_fisheye": True, "k1": 0.1, "p1": 0.1}, {}, "p1"),
        ({"ftheta_p0": 0.1}, {}, "ftheta_p0"),
        ({"latlong": True}, {}, "latlong"),
        ({"fisheye_crop_radius": 20}, {}, "fisheye_crop_radius"),
        ({"rolling_shutter": [0, 0, 1, 0]}, {}, "rolling_shutter"),
        ({}, {"rolling_shutter_time": 0.005}, "rolling_shutter"),
        ({"intrinsic_matrix": MATRIX}, {}, "fl_x"),
        ({}, {"file_path": "", "rgb_path": "a.png", "camtoworld": MATRIX}, "camtoworld, "),
        ({"normal_mts_args": {}}, {}, "normal_mts_args"),
        ({}, {"transform_matrix_end": np.diag([1.0, 1, 1, 1]).tolist()}, "transform_matrix_end"),
        # resized pictures: the angle contradicts the focal length
        ({"camera_angle_x": ANGLE, "w": WIDTH / 2, "h": HEIGHT / 2}, {}, "focal lengths of"),
        ({"w": None, "h": None, "cx": 66, "cy": 46}, {}, "66"),
        ({"w": None}, {}, "None"),
    ],
)
def test_other_lenses_frames_and_sizes_are_refused_by_name(
    tmp_path: Path, top: dict, frame: dict, found: str
) -> None:
    Fault(found=found).raised_by(
        read_pose_file, write_json(tmp_path / "t.json", {**WHOLE, **top}, frame), VIEWS, stated
    )


def test_fields_that_are_not_known_are_named(tmp_path: Path) -> None:
    path = write_json(tmp_path / "t.json", {**WHOLE, "tilt": 3}, {"lens_id": 1})
    with pytest.warns(PolarguideWarning, match=r"t\.json .*: lens_id, tilt"):
        read_pose_file(path, VIEWS, stated)
    np.savez(tmp_path / "c.npz", **idr_cameras(), distortion=np.zeros(5))
    with pytest.warns(PolarguideWarning, match=r"c\.npz .*: distortion"):
        read_pose_file(tmp_path / "c.npz", VIEWS, stated)


@pytest.mark.parametrize(
    ("top", "frame"),
    [
        ({}, {"sharpness": math.nan}),
        ({}, {"time": -math.inf}),
        ({"aabb_scale": math.inf}, {}),
        ({"offset": [0, math.nan, 0], "applied_transform": [[math.nan]]}, {"depth_file_path": [math.nan]}),
    ],
)
def test_fields_that_are_not_used_may_hold_anything(tmp_path: Path, top: dict, frame: dict) -> None:
    cameras = read_pose_file(write_json(tmp_path / "t.json", {**WHOLE, **top}, frame), VIEWS, stated)
    assert {camera.parameters for camera in cameras.values()} == {(90, 92, 33, 23)}


@pytest.mark.parametrize(
    ("top", "frame", "field"), [({"cx": math.nan}, {}, "cx"), ({}, {"fl_x": math.inf}, "frames[0].fl_x")]
)
def test_fields_that_are_used_must_be_finite(tmp_path: Path, top: dict, frame: dict, field: str) -> None:
    path = write_json(tmp_path / "t.json", {**WHOLE, **top}, frame)
    Fault(f"t.json ({field})", expected="a finite number").raised_by(read_pose_file, path, VIEWS, stated)


@pytest.mark.parametrize(
    ("inner", "size"), [(INNER, (WIDTH, HEIGHT)), (np.diag([2, 2, 1]) @ INNER, (128, 96))]
)
def test_a_size_that_the_file_lacks_is_that_of_the_pictures_it_fits(
    tmp_path: Path, inner: np.ndarray, size: tuple[int, int]
) -> None:
    np.savez(tmp_path / "c.npz", **idr_cameras(inner))
    found = read_pose_file(tmp_path / "c.npz", VIEWS, lambda view: ((128, 96), (WIDTH, HEIGHT)))
    assert {(camera.width, camera.height) for camera in found.values()} == {size}
    Fault(expected="400x300").raised_by(read_pose_file, tmp_path / "c.npz", VIEWS, lambda view: ((400, 300),))


@pytest.mark.parametrize(
    ("entry", "matrix", "found"),
    [
        ("camera_mat_1", np.diag([1.8, 1.8, 1.0, 1.0]), "camera_mat_1"),
        ("camera_mat_1", np.zeros(()), "camera_mat_1"),
        ("world_mat_02", np.eye(4), "two"),
        ("scale_mat_1", np.diag([1.0, 1.0, 2.0, 1.0]), "singular values"),
    ],
)
def test_idr_cameras_of_another_unit_or_number_are_refused(
    tmp_path: Path, entry: str, matrix: np.ndarray, found: str
) -> None:
    np.savez(tmp_path / "c.npz", **idr_cameras(), camera_mat_0=np.eye(4), world_mat_inv_0=np.eye(4))
    read_pose_file(tmp_path / "c.npz", VIEWS, stated)
    np.savez(tmp_path / "c.npz", **{**idr_cameras(), entry: matrix})
    Fault(found=found).raised_by(read_pose_file, tmp_path / "c.npz", VIEWS, stated)


def test_views_never_take_the_cameras_of_others_by_number(tmp_path: Path) -> None:
    """Cameras from 0 and views from 1: of as many, in order; of fewer, refused rather than shifted by one."""
    np.savez(tmp_path / "c.npz", **idr_cameras())
    found = read_pose_file(tmp_path / "c.npz", ["1", "2", "3", "4"], stated)
    np.testing.assert_allclose(found["1"].rotation, next(iter(poses()))[0], atol=1e-6)
    for views in (["1", "2", "3"], ["1", "2", "3", "5"]):
        Fault(found="4 cameras, world_mat_0 to world_mat_3").raised_by(
            read_pose_file, tmp_path / "c.npz", views, stated
        )


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("</f>", "</f><k4>0.1</k4>", "k4 = 0.1"),
        ("</f>", "</f><p3>0.01</p3>", "p3 = 0.01"),
        ("</f>", "</f><b2>2.5</b2>", "b2 = 2.5"),
        ('calibration type="frame"', 'calibration type="fisheye"', "a fisheye camera"),
        ('type="frame"><resolution', 'type="spherical"><resolution', "a spherical camera"),
        ('type="frame"><resolution', 'type="equisolid_fisheye"><resolution', "a equisolid_fisheye camera"),
        ("</sensor>", "<rolling_shutter>full</rolling_shutter></sensor>", "rolling_shutter"),
        ('label="a.JPG"', 'component_id="1" label="a.JPG"', "none with 3"),
        ("</chunk>", '</chunk><chunk label="C2"><cameras><camera><transform>1</transform></camera></cameras></chunk>',
         "2 chunks (Chunk 1, C2)"),
    ],
)  # fmt: skip
def test_metashape_of_another_lens_or_frame_is_refused(
    tmp_path: Path, old: str, new: str, found: str
) -> None:
    path = tmp_path / "cameras.xml"
    write_metashape(path, {"f": 90.0}, ["a.JPG", "b", "c", "d"])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    Fault(found=found).raised_by(read_pose_file, path, VIEWS, unknown)


def test_metashape_cameras_that_are_not_enabled_are_left_out_and_other_elements_named(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    write_metashape(path, {"f": 90.0}, VIEWS)
    text = path.read_text().replace('label="a"', 'enabled="false" label="a"')
    path.write_text(text.replace("</f>", "</f><q1>0.1</q1>"))
    with pytest.warns(PolarguideWarning) as caught:
        assert sorted(read_pose_file(path, VIEWS, unknown)) == VIEWS[1:]
    texts = [str(one.message) for one in caught]
    assert any("1 disabled" in text for text in texts)
    assert any(text.endswith(": q1.") for text in texts)


def test_points_in_names_of_views_begin_no_suffix(tmp_path: Path) -> None:
    """Metashape's labels have none; what has no label is no picture. Frames may be in a second list."""
    views = ["a.left", "a.right", "b.v2", "c"]
    write_metashape(tmp_path / "c.xml", {"f": 90.0}, ["a.left", "a.right.JPG", "b.v2", "c.png"], 2 * UNNAMED)
    assert sorted(read_pose_file(tmp_path / "c.xml", views, unknown)) == views
    frames = [{"file_path": f"images/{v}", "transform_matrix": np.eye(4).tolist()} for v in views]
    (tmp_path / "t.json").write_text(json.dumps({**WHOLE, "frames": frames[:2], "test_frames": frames[2:]}))
    assert sorted(read_pose_file(tmp_path / "t.json", views, unknown)) == views


UNNAMED = '<camera id="7" sensor_id="0"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>'


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("c.xml", "<document", Fault(found="cannot be parsed")),
        ("c.xml", "<!DOCTYPE a [<!ENTITY b 'c'>]><a/>", Fault(expected="exported by Metashape")),
        ("c.xml", "<document/>", Fault(expected="cameras with a pose", found="none")),
        ("t.json", '{"frames": []}', Fault(expected="cameras with a pose", found="none")),
        ("t.json", '{"frames": [{"file_path": "a.png", "transform_matrix": [[1]]}]}', Fault(expected="4x4")),
        ("t.json", '{"camera_model": "FISHEYE624", "w": 4, "h": 4, "fl_x": 3, "frames": [{"file_path": "a.png", '
         '"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}', Fault(expected="a camera of OPENCV")),
        ("t.json", '{"frames": [{"file_path": "a.png", '
         '"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}', Fault(expected="a focal length")),
    ],
)  # fmt: skip
def test_files_that_are_none(tmp_path: Path, name: str, content: str, fault: Fault) -> None:
    (tmp_path / name).write_text(content)
    fault.raised_by(read_pose_file, tmp_path / name, VIEWS, stated)
