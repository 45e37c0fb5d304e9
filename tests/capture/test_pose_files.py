"""Poses of other programs: nerfstudio, Metashape, IDR. Projections are compared with their own formulas."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from dataset_files import HEIGHT, INNER, WIDTH, idr_cameras, poses

from polarguide.capture.colmap.files import colmap_camera
from polarguide.capture.pose_files import read_pose_file
from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera
from polarguide.results.export.placement import write_transforms

VIEWS = ["a", "b", "c", "d"]
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


def write_metashape(path: Path, lens: dict[str, float], labels: list[str], more: str = "") -> None:
    values = "".join(f"<{name}>{value!r}</{name}>" for name, value in lens.items())
    cameras = ""
    for label, (rotation, translation) in zip(labels, poses(), strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ translation
        numbers = " ".join(repr(float(number)) for number in matrix.ravel())
        cameras += f'<camera id="0" sensor_id="0" label="{label}"><transform>{numbers}</transform></camera>'
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1"><sensors>'
        f'<sensor id="0" label="x" type="frame"><resolution width="{WIDTH}" height="{HEIGHT}"/>'
        f'<calibration type="frame" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>{values}'
        f"</calibration></sensor></sensors><cameras>{cameras}"
        f'<camera id="9" sensor_id="0" label="unaligned"/>{more}</cameras></chunk></document>'
    )


def test_metashape_projects_as_its_manual_says(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    write_metashape(path, LENS, ["a.JPG", "b.JPG", "c.JPG", "d.JPG"])
    found = read_pose_file(path, VIEWS, (0, 0))
    assert sorted(found) == VIEWS
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3))
    for view, (rotation, translation) in zip(VIEWS, poses(), strict=True):
        local = points @ rotation.T + translation
        x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
        r2 = x * x + y * y
        bend = 1 + LENS["k1"] * r2 + LENS["k2"] * r2**2 + LENS["k3"] * r2**3
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
        camera = read_pose_file(path, VIEWS, (0, 0))[view]
        assert (camera.model, camera.width, camera.height) == ("PINHOLE", WIDTH, HEIGHT)
        assert camera.parameters == pytest.approx((90, 92, 33, 23))
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-9)
        np.testing.assert_allclose(camera.translation, translation, atol=1e-9)


def test_nerfstudio_with_one_lens_for_all_frames(tmp_path: Path) -> None:
    lens = {"camera_angle_x": 2 * math.atan(WIDTH / 2 / 90), "w": WIDTH, "h": HEIGHT, "k1": 0.01, "p2": 0.002}
    frames = [{"file_path": f"./images/{v}.jpg", "transform_matrix": np.eye(4).tolist()} for v in VIEWS]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**lens, "frames": frames}))
    camera = read_pose_file(path, VIEWS, (0, 0))["b"]
    assert camera.model == "FULL_OPENCV"
    expected = (90, 90, WIDTH / 2, HEIGHT / 2, 0.01, 0, 0, 0.002, 0, 0, 0, 0)
    assert camera.parameters == pytest.approx(expected)


def test_idr_cameras_belong_to_views_by_number_or_in_order(tmp_path: Path) -> None:
    path = tmp_path / "cameras_new.npz"
    np.savez(path, **idr_cameras())
    for views in (["0", "1", "2", "3"], VIEWS):
        found = read_pose_file(path, views, (WIDTH, HEIGHT))
        for view, (rotation, _) in zip(views, poses(), strict=True):
            np.testing.assert_allclose(found[view].rotation, rotation, atol=1e-6)
            assert found[view].parameters == pytest.approx((INNER[0, 0], INNER[1, 1], 33, 23))
    with pytest.raises(PolarguideError, match="as many cameras as views, 3"):
        read_pose_file(path, VIEWS[:3], (WIDTH, HEIGHT))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("c.xml", "<document", "cannot be parsed"),
        ("c.xml", "<!DOCTYPE a [<!ENTITY b 'c'>]><a/>", "exported by Metashape"),
        ("c.xml", "<document/>", "cameras with a pose, found none"),
        ("t.json", '{"frames": []}', "cameras with a pose, found none"),
        ("t.json", '{"frames": [{"file_path": "a.png", "transform_matrix": [[1]]}]}', "4x4"),
        ("t.json", '{"camera_model": "OPENCV_FISHEYE", "w": 4, "h": 4, "fl_x": 3, "frames": [{"file_path": "a.png", '
         '"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}', "a perspective camera"),
        ("t.json", '{"frames": [{"file_path": "a.png", '
         '"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}', "width and height"),
    ],
)  # fmt: skip
def test_files_that_are_none(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(PolarguideError, match=message):
        read_pose_file(tmp_path / name, VIEWS, (WIDTH, HEIGHT))
