"""Scenes as they are loaded, and the views that are held out."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from heard import Heard
from PIL import Image
from tiny_capture import NAMES, TinyCapture

from polarguide.capture import load_scene
from polarguide.capture.scene import TEST_EVERY, chosen_views
from polarguide.geometry.camera import Camera, look_at


def test_intensities_are_those_that_were_written(capture: TinyCapture) -> None:
    scene = load_scene(capture.root)
    assert [view.name for view in scene.views] == list(NAMES)
    for view in scene.views:
        assert (view.codes.dtype, view.intensities().dtype) == (torch.uint16, torch.float32)
        assert view.intensities().shape == (4, 10, 12, 3)
        np.testing.assert_allclose(view.intensities().numpy(), capture.linear[view.name], atol=0.51 / 65535)


def test_photograph_is_half_of_s0(capture: TinyCapture) -> None:
    view = load_scene(capture.root).views[0]
    s0 = view.intensities()[0] + view.intensities()[2]
    torch.testing.assert_close(view.photograph(), s0 / 2, atol=2e-5, rtol=0)


def test_a_plain_capture_has_no_warnings_masks_or_truth(capture: TinyCapture) -> None:
    scene = load_scene(capture.root)
    assert (scene.warnings, scene.name, scene.downscale, scene.transfer) == ((), "tiny", 1, "linear")
    assert scene.refractive_index is None
    for view in scene.views:
        assert view.mask is None
        assert view.ground_truth is None
        assert not view.invalid.any()
        assert not view.saturated.any()


def test_cameras_and_points_are_those_of_the_model(capture: TinyCapture) -> None:
    scene = load_scene(str(capture.root))
    camera = scene.view("v003").camera
    assert (camera.width, camera.height) == (12, 10)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (15.5, 15.25, 6.5, 4.75)
    quarter_turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(camera.rotation, quarter_turn, atol=1e-12, rtol=0)
    torch.testing.assert_close(camera.translation, torch.tensor([0.3, -0.25, 2.5], dtype=torch.float64))
    assert scene.points.tolist() == [[-1, 0, 2], [0, 0, 3], [1, 1, 1], [0.5, 0.25, 1.5]]
    assert scene.point_colors.dtype == torch.uint8
    assert scene.point_colors.tolist() == [[255, 0, 128], [1, 2, 3], [4, 5, 6], [10, 20, 30]]


def test_every_eighth_view_is_held_out_where_that_is_asked_for(capture: TinyCapture) -> None:
    scene = load_scene(capture.root, split="every-8th")
    assert scene.test_names == ("v000", "v008")
    assert [view.name for view in scene.test_views] == ["v000", "v008"]
    assert [view.name for view in scene.train_views] == list(NAMES[1:8])


def test_one_view_in_eight_is_held_out_by_its_direction_by_default(capture: TinyCapture) -> None:
    scene = load_scene(capture.root)
    cameras = {view.name: view.camera for view in scene.views}
    assert (scene.test_names, len(scene.test_names)) == (chosen_views(cameras, "directions"), 2)


def test_a_split_that_there_is_not_is_refused(capture: TinyCapture) -> None:
    Fault("split", expected="one of directions, every-8th").raised_by(load_scene, capture.root, split="odd")  # type: ignore[arg-type]


def test_split_file_overrides_the_default(capture: TinyCapture) -> None:
    capture.write_json("split.json", {"test": ["v004", "v001"], "note": "other keys are ignored"})
    assert load_scene(capture.root).test_names == ("v001", "v004")


def test_selected_views_keep_the_split_of_the_whole_capture(capture: TinyCapture) -> None:
    scene = load_scene(capture.root, views=["v008", "v003", "v003"], split="every-8th")
    assert ([view.name for view in scene.views], scene.test_names) == (["v003", "v008"], ("v008",))
    assert scene.warnings == ()


def test_damage_in_views_that_are_not_selected_does_not_matter(capture: TinyCapture) -> None:
    capture.picture("v005", 90).unlink()
    capture.picture("v006", 90).write_bytes(b"")
    assert len(load_scene(capture.root, views=["v000", "v001"]).views) == 2


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        ({"refractive_index": 1.33}, 1.33),
        ({"refractive_index": 1.4, "objects": [{"material": {"ior": 1.5}}]}, 1.4),
        ({"objects": [{"material": {"ior": 1.5}}, {"material": {"type": "metal"}}, {"name": "x"}]}, 1.5),
        ({"objects": [{"material": {"ior": 1.5}}, {"material": {"ior": 1.33}}]}, None),
        ({"objects": [{"material": {"ior": 4.05}}]}, None),
        ({"exposure": 2.0}, None),
    ],
)
def test_refractive_index(capture: TinyCapture, scene: dict[str, object], expected: float | None) -> None:
    capture.write_json("scene.json", scene)
    assert load_scene(capture.root).refractive_index == expected


def test_masks_of_any_convention(capture: TinyCapture) -> None:
    half = np.zeros((10, 12), np.uint8)
    half[:, :5] = 1
    (capture.root / "masks").mkdir()
    pictures = {
        "v000": half,
        "v001": half * 255,
        "v002": half.astype(np.uint16) * 65535,
        "v003": np.repeat(half[..., None] * 255, 3, axis=2),
        "v004": np.where(half > 0, 255, 100).astype(np.uint8),
        "v005": half * 0,
    }
    for name, picture in pictures.items():
        cv2.imwrite(str(capture.root / "masks" / f"{name}.png"), picture)
    scene = load_scene(capture.root)
    for name in ("v000", "v001", "v002", "v003", "v004"):
        mask = scene.view(name).mask
        assert mask.dtype == torch.bool
        assert torch.equal(mask, torch.from_numpy(half > 0))
    assert not scene.view("v005").mask.any()
    assert scene.view("v006").mask is None
    assert scene.warnings == ("masks/ has no file for 3 of 9 views (v006, v007, v008).",)


@pytest.mark.parametrize(
    ("suffix", "options", "lossless"),
    [
        (".png", {}, True),
        (".webp", {"lossless": True}, True),
        (".tif", {"compression": "tiff_lzw"}, True),
        (".jpg", {"quality": 100}, False),
        (".webp", {"quality": 90}, False),
        (".tif", {"compression": "jpeg"}, False),
    ],
)
def test_materials_of_lossy_files_are_refused(
    capture: TinyCapture, suffix: str, options: dict[str, Any], lossless: bool
) -> None:
    """Compression makes other numbers of the numbers of materials."""
    height, width = 10, 12
    path = capture.root / "materials" / f"v003{suffix}"
    path.parent.mkdir()
    numbers = np.zeros((height, width, 3) if suffix == ".webp" else (height, width), np.uint8)
    numbers[:, width // 2 :] = 2
    Image.fromarray(numbers).save(path, **options)
    if lossless:
        found = load_scene(capture.root).view("v003").materials
        assert found is not None
        assert (found.numpy() == (numbers if numbers.ndim == 2 else numbers[..., 0])).all()
    else:
        Fault(str(path), expected="lossless", remedy="PNG").raised_by(load_scene, capture.root)


@pytest.mark.parametrize("folder", ["materials", "masks", "gt"])
@pytest.mark.parametrize("how", ["link", "file"])
def test_a_folder_of_a_scene_that_is_none_is_refused(capture: TinyCapture, folder: str, how: str) -> None:
    path = capture.root / folder
    shutil.rmtree(path, ignore_errors=True)
    if how == "link":
        path.symlink_to("nowhere")
    else:
        path.write_text("labels")
    Fault(str(path), "a folder of files").raised_by(load_scene, capture.root)


def test_materials_of_any_number_of_views(capture: TinyCapture) -> None:
    numbers = np.zeros((10, 12), np.uint8)
    numbers[:, 4:8], numbers[:, 8:] = 1, 2
    (capture.root / "materials").mkdir()
    cv2.imwrite(str(capture.root / "materials" / "v003.png"), numbers)
    scene = load_scene(capture.root)
    assert torch.equal(scene.view("v003").materials, torch.from_numpy(numbers))
    assert scene.view("v002").materials is None
    assert not scene.warnings
    numbers[:, 7] = 2  # half of a box
    cv2.imwrite(str(capture.root / "materials" / "v003.png"), numbers)
    assert load_scene(capture.root, downscale=2).view("v003").materials[0].tolist() == [0, 0, 1, 0, 2, 2]


@pytest.mark.parametrize(
    ("picture", "fault"),
    [
        (np.full((10, 12), 255, np.uint8), Fault(found="255")),
        (np.full((10, 12), 3, np.uint8), Fault(remedy="0 (unknown), 1 (dielectric) and 2 (metal)")),
        (np.zeros((10, 11), np.uint8), Fault(found="11x10")),
    ],
)
def test_materials_of_another_size_or_number_are_refused(
    capture: TinyCapture, picture: np.ndarray, fault: Fault
) -> None:
    (capture.root / "materials").mkdir()
    cv2.imwrite(str(capture.root / "materials" / "v001.png"), picture)
    refused = fault.raised_by(load_scene, capture.root)
    assert "v001.png" in str(refused)
    assert len(str(refused).splitlines()) == 1


def test_invalid_pixels_come_from_the_file_alone(capture: TinyCapture) -> None:
    marked = np.zeros((10, 12), np.uint8)
    marked[2, 3] = 1
    (capture.root / "invalid").mkdir()
    cv2.imwrite(str(capture.root / "invalid" / "v001.png"), marked)
    scene = load_scene(capture.root)
    assert scene.view("v001").invalid.nonzero().tolist() == [[2, 3]]
    assert not scene.view("v001").saturated.any()
    assert not scene.view("v002").invalid.any()


def _invalid(capture: TinyCapture, names: list[str]) -> None:
    (capture.root / "invalid").mkdir()
    for name in names:
        cv2.imwrite(str(capture.root / "invalid" / f"{name}.png"), np.full((10, 12), 255, np.uint8))


def test_training_views_that_are_all_invalid_are_refused(capture: TinyCapture) -> None:
    capture.write_json("split.json", {"test": ["v000"]})
    _invalid(capture, [name for name in NAMES if name != "v000"])
    Fault(expected="one valid pixel", found="none in 8 views").raised_by(load_scene, capture.root)
    assert (
        load_scene(capture.root, views=["v000", "v001"]).view("v001").invalid.all()
    )  # somebody looks at them


def test_views_that_are_all_invalid_are_a_warning(capture: TinyCapture) -> None:
    _invalid(capture, ["v001", "v003"])
    (warning,) = load_scene(capture.root).warnings
    assert re.match(r"2 of 9 views .*valid.*\(v001, v003\)", warning)


def test_angles_that_are_one_file_are_a_warning(capture: TinyCapture) -> None:
    for angle in ("045", "090", "135"):
        shutil.copyfile(capture.root / "polar/v002_000.png", capture.root / f"polar/v002_{angle}.png")
    (warning,) = load_scene(capture.root).warnings
    assert warning.startswith("1 of 9 views have the same file at all angles (v002)")


def test_progress_counts_the_views(capture: TinyCapture) -> None:
    heard = Heard()
    load_scene(capture.root, reporter=heard)
    assert heard.tracked == [("reading tiny", 9, list(range(1, 10)))]


def test_digest_follows_contents_and_names_but_not_the_place(capture: TinyCapture, tmp_path: Path) -> None:
    first = load_scene(capture.root).digest
    assert (len(first), load_scene(capture.root, downscale=2).digest) == (64, first)
    shutil.copytree(capture.root, tmp_path / "copy")
    assert load_scene(tmp_path / "copy").digest == first
    assert load_scene(capture.root, views=NAMES[:3]).digest != first
    capture.write_json("split.json", {"test": ["v000", "v008"]})
    second = load_scene(capture.root).digest
    capture.picture("v004", 45).write_bytes(capture.picture("v004", 90).read_bytes())
    assert len({first, second, load_scene(capture.root).digest}) == 3


def test_unknown_view_names_its_neighbors(capture: TinyCapture) -> None:
    scene = load_scene(capture.root)
    Fault(expected="one of the 9 views", found="'v0O4'", remedy="v004").raised_by(scene.view, "v0O4")
    Fault("(views)", found="'v04'", remedy="v004").raised_by(load_scene, capture.root, views=["v000", "v04"])


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ({"downscale": 0}, Fault("downscale", "1 or more", "0")),
        ({"downscale": 1.5}, Fault(found="1.5")),
        ({"downscale": True}, Fault(found="True")),
        ({"downscale": 11}, Fault("downscale", "at most 10 for pictures of 12x10", "11")),
        ({"transfer": "gamma"}, Fault("transfer", "one of linear, srgb", "gamma")),
        ({"views": []}, Fault("views", "at least one view name", "an empty list")),
    ],
)
def test_arguments_out_of_range(capture: TinyCapture, arguments: dict[str, object], fault: Fault) -> None:
    fault.raised_by(load_scene, capture.root, **arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("split.json", "{", Fault("split.json", "a JSON file", "broken JSON")),
        ("split.json", "[]", Fault("split.json", "a JSON object {...}", "[]")),
        ("split.json", '{"tests": []}', Fault("split.json", "the field test", "only tests")),
        (
            "split.json",
            '{"test": [3]}',
            Fault("split.json (test[0])", "text", "3", '{"test"'),
        ),
        (
            "split.json",
            '{"test": ["v000", "v0010"]}',
            Fault("split.json (test)", found="'v0010'", remedy="v001"),
        ),
        ("scene.json", '{"refractive_index": 0.5}', Fault("scene.json (refractive_index)", "above 1", "0.5")),
        ("scene.json", '{"refractive_index": "glass"}', Fault(found='"glass"')),
        ("scene.json", '{"refractive_index": true}', Fault(expected="a number or null", found="true")),
        ("scene.json", "\ufeff\ufeff", Fault(found="broken JSON")),
    ],
)
def test_broken_side_files(capture: TinyCapture, name: str, text: str, fault: Fault) -> None:
    (capture.root / name).write_text(text, encoding="utf-8")
    fault.raised_by(load_scene, capture.root)


def test_all_views_in_the_test_set(capture: TinyCapture) -> None:
    capture.write_json("split.json", {"test": list(NAMES)})
    Fault(expected="one training view", found="all 9 views").raised_by(load_scene, capture.root)


RINGS, STOPS = 8, 12


def at(height: float, degrees: float) -> Camera:
    """A camera on a dome about the origin, looking at it."""
    up, around = math.radians(height), math.radians(degrees)
    center = (3 * math.cos(up) * math.cos(around), 3 * math.cos(up) * math.sin(around), 3 * math.sin(up))
    return Camera(24, 20, 28.0, 28.0, 12.0, 10.0, *look_at(center, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))


def dome() -> dict[str, Camera]:
    """Column by column, as a turntable with eight cameras above each other gives: every 8th is the lowest ring."""
    return {
        f"v{stop:02d}_{ring}": at(5 + 9 * ring, 360 / STOPS * stop)
        for stop in range(STOPS)
        for ring in range(RINGS)
    }


def test_no_ring_is_held_out_as_a_whole_where_every_eighth_would() -> None:
    cameras = dome()
    assert set([name[-1] for name in chosen_views(cameras, "every-8th")]) == {"0"}
    chosen = chosen_views(cameras, "directions")
    assert len(chosen) == len(cameras) / TEST_EVERY
    assert max([name[-1] for name in chosen].count(ring) for ring in map(str, range(RINGS))) < STOPS / 2
    assert len({name[:3] for name in chosen}) > STOPS / 3


def test_every_held_out_view_has_training_views_near_it() -> None:
    cameras = dome()
    chosen = chosen_views(cameras, "directions")
    centers = {name: camera.center for name, camera in cameras.items()}
    trains = torch.stack([center for name, center in centers.items() if name not in chosen])
    apart = {name: float((trains - centers[name]).norm(dim=1).min()) for name in chosen}
    assert max(apart.values()) <= 2 * math.sin(math.radians(9) / 2) * 3 + 1e-6, (
        "the next ring of the same column"
    )
    assert chosen == chosen_views(dict(reversed(cameras.items())), "directions"), "the order does not matter"


def test_a_view_apart_from_all_others_is_trained_on() -> None:
    cameras = {f"v{k:02d}": at(20, 3 * k) for k in range(23)} | {"w": at(80, 200)}
    assert "w" not in chosen_views(cameras, "directions")


@pytest.mark.parametrize(("views", "tests"), [(1, 0), (2, 1), (3, 1), (8, 1), (9, 2), (17, 3)])
def test_one_in_eight_is_held_out_and_never_all(views: int, tests: int) -> None:
    cameras = {f"v{k:02d}": at(20, 11 * k) for k in range(views)}
    for split in ("directions", "every-8th"):
        chosen = chosen_views(cameras, split)
        assert len(set(chosen)) == tests
        assert set(chosen) <= set(cameras)


def test_cameras_in_one_place_that_look_into_one_direction_can_be_split() -> None:
    cameras = {f"v{k:02d}": at(20, 0) for k in range(20)}
    assert len(set(chosen_views(cameras, "directions"))) == 3
