"""Wrong matches, of which some geometry fits a part, are not taken for a scene."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from polarguide.capture.colmap import sfm
from polarguide.capture.colmap.sfm import NotConnectedError, connected_views, log_false_alarms, reconstruct
from polarguide.progress import SILENT

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
    monkeypatch.setattr(sfm, "_map", lambda *_, **__: {0: model})
    with pytest.raises(NotConnectedError, match="3 of 3 views registered, by matches that agree no better"):
        reconstruct(tmp_path, SIZES, matching="exhaustive", seed=0, reporter=SILENT, untried="")
    assert not (tmp_path / "model").exists()


def test_false_alarms_become_fewer_with_every_match_that_agrees() -> None:
    numbers = [log_false_alarms(100, agreeing, 0.1) for agreeing in range(8, 101)]
    assert log_false_alarms(100, 7, 0.1) == math.inf
    assert numbers[0] > 0 > numbers[-1]
    # All agree: one choice of them, and of seven of them, to the power of the other 93.
    assert numbers[-1] == pytest.approx(math.log(93) + math.log(math.comb(100, 7)) + 93 * math.log(0.1))
