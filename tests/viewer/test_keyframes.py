"""A path set down pose by pose is one that ``render --path`` reads."""

from __future__ import annotations

import pytest
import torch
from random_runs import ring

from polarguide.trajectory import read_path
from polarguide.viewer.keyframes import FRAMES_PER_SECOND, Keyframes


def test_a_path_goes_through_its_poses(tmp_path):
    keyframes, poses = Keyframes((80, 50)), list(ring().values())[:3]
    for camera in poses:
        keyframes.add(camera)
    file = tmp_path / "path.json"
    file.write_text(keyframes.to_json(1.5))
    cameras, speed = read_path(file)
    step = round(1.5 * FRAMES_PER_SECOND)
    assert (speed, len(cameras)) == (FRAMES_PER_SECOND, 1 + 2 * step)
    assert {(c.width, c.height) for c in cameras} == {(80, 50)}
    for pose, camera in zip(poses, cameras[::step], strict=True):
        assert torch.allclose(camera.center, pose.center, atol=1e-9)
        assert torch.allclose(camera.rotation, pose.rotation, atol=1e-9)
        # The same from top to bottom.
        assert camera.height / camera.fy == pytest.approx(pose.height / pose.fy)


def test_one_pose_is_a_path_of_one_and_none_is_none():
    keyframes = Keyframes((80, 50))
    assert keyframes.path(2.0) == []
    keyframes.add(ring()["v0"])
    assert len(keyframes.path(2.0)) == 1
