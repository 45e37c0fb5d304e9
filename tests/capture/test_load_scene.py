"""A valid capture becomes the scene its files describe."""

from __future__ import annotations

import re
import shutil
from dataclasses import FrozenInstanceError
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from heard import Heard
from tiny_capture import NAMES, TinyCapture

from polarguide.capture import load_scene
from polarguide.capture.split import chosen_views
from polarguide.errors import PolarguideError


def test_intensities_are_those_that_were_written(capture: TinyCapture) -> None:
    scene = load_scene(capture.root)
    assert [view.name for view in scene.views] == list(NAMES)
    for view in scene.views:
        assert view.codes.dtype == torch.uint16
        assert view.intensities().dtype == torch.float32
        assert view.intensities().shape == (4, 10, 12, 3)
        np.testing.assert_allclose(view.intensities().numpy(), capture.linear[view.name], atol=0.51 / 65535)


def test_photograph_is_half_of_s0(capture: TinyCapture) -> None:
    view = load_scene(capture.root).views[0]
    s0 = view.intensities()[0] + view.intensities()[2]
    torch.testing.assert_close(view.photograph(), s0 / 2, atol=2e-5, rtol=0)


def test_a_plain_capture_has_no_warnings_masks_or_truth(capture: TinyCapture) -> None:
    scene = load_scene(capture.root)
    assert scene.warnings == ()
    assert (scene.name, scene.downscale, scene.transfer) == ("tiny", 1, "linear")
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
    assert scene.test_names == chosen_views(cameras, "directions")
    assert len(scene.test_names) == 2


def test_test_views_far_from_training_are_a_warning(capture: TinyCapture) -> None:
    capture.write_json("split.json", {"test": list(NAMES[:6])})
    (warning,) = load_scene(capture.root).warnings
    assert re.search(r"\d of 6 test views are far from every training view \(v000, .*split\.json", warning)


def test_a_ring_that_is_held_out_as_a_whole_is_a_warning(
    capture: TinyCapture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("polarguide.capture.reader.held_out_band", lambda _, tests: list(tests))
    capture.write_json("split.json", {"test": list(NAMES[:2])})
    (warning,) = load_scene(capture.root).warnings
    assert "2 of 2 test views are all of a band of heights, such as a ring (v000, v001)" in warning
    assert warning.endswith("name others in split.json.")


def test_a_split_that_there_is_not_is_refused(capture: TinyCapture) -> None:
    with pytest.raises(PolarguideError, match="split: expected one of directions, every-8th"):
        load_scene(capture.root, split="odd")  # type: ignore[arg-type]


def test_split_file_overrides_the_default(capture: TinyCapture) -> None:
    capture.write_json("split.json", {"test": ["v004", "v001"], "note": "other keys are ignored"})
    assert load_scene(capture.root).test_names == ("v001", "v004")


def test_selected_views_keep_the_split_of_the_whole_capture(capture: TinyCapture) -> None:
    scene = load_scene(capture.root, views=["v008", "v003", "v003"], split="every-8th")
    assert [view.name for view in scene.views] == ["v003", "v008"]
    assert scene.test_names == ("v008",)
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
        assert mask is not None
        assert mask.dtype == torch.bool
        assert torch.equal(mask, torch.from_numpy(half > 0))
    empty = scene.view("v005").mask
    assert empty is not None
    assert not empty.any()
    assert scene.view("v006").mask is None
    assert scene.warnings == ("masks/ has no file for 3 of 9 views (v006, v007, v008).",)


def test_materials_of_any_number_of_views(capture: TinyCapture) -> None:
    numbers = np.zeros((10, 12), np.uint8)
    numbers[:, 4:8], numbers[:, 8:] = 1, 2
    (capture.root / "materials").mkdir()
    cv2.imwrite(str(capture.root / "materials" / "v003.png"), numbers)
    scene = load_scene(capture.root)
    found = scene.view("v003").materials
    assert found is not None
    assert torch.equal(found, torch.from_numpy(numbers))
    assert scene.view("v002").materials is None
    assert not scene.warnings
    numbers[:, 7] = 2  # half of a box
    cv2.imwrite(str(capture.root / "materials" / "v003.png"), numbers)
    halved = load_scene(capture.root, downscale=2).view("v003").materials
    assert halved is not None
    assert halved[0].tolist() == [0, 0, 1, 0, 2, 2]


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.full((10, 12), 255, np.uint8), "255"),
        (np.full((10, 12), 3, np.uint8), "0 (unknown), 1 (dielectric) and 2 (metal)"),
        (np.zeros((10, 11), np.uint8), "11x10"),
    ],
)
def test_materials_of_another_size_or_number_are_refused(
    capture: TinyCapture, picture: np.ndarray, words: str
) -> None:
    (capture.root / "materials").mkdir()
    cv2.imwrite(str(capture.root / "materials" / "v001.png"), picture)
    with pytest.raises(PolarguideError, match=re.escape(words)) as refused:
        load_scene(capture.root)
    assert "v001.png" in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


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
    with pytest.raises(
        PolarguideError, match="one pixel to train on that is not invalid, found none in 8 views"
    ):
        load_scene(capture.root)
    assert (
        load_scene(capture.root, views=["v000", "v001"]).view("v001").invalid.all()
    )  # somebody looks at them


def test_views_that_are_all_invalid_are_a_warning(capture: TinyCapture) -> None:
    _invalid(capture, ["v001", "v003"])
    (warning,) = load_scene(capture.root).warnings
    assert warning.startswith("2 of 9 views are invalid at every pixel (v001, v003): they tell nothing.")


def test_angles_that_are_one_file_are_a_warning(capture: TinyCapture) -> None:
    for angle in ("045", "090", "135"):
        shutil.copyfile(capture.root / "polar/v002_000.png", capture.root / f"polar/v002_{angle}.png")
    (warning,) = load_scene(capture.root).warnings
    assert warning.startswith(
        "The pictures at all angles are the same file in 1 of 9 views (v002): they look"
    )


def test_progress_counts_the_views(capture: TinyCapture) -> None:
    heard = Heard()
    load_scene(capture.root, reporter=heard)
    assert heard.tracked == [("reading tiny", 9, list(range(1, 10)))]


def test_digest_follows_contents_and_names_but_not_the_place(capture: TinyCapture, tmp_path: Path) -> None:
    first = load_scene(capture.root).digest
    assert len(first) == 64
    assert load_scene(capture.root, downscale=2).digest == first
    shutil.copytree(capture.root, tmp_path / "copy")
    assert load_scene(tmp_path / "copy").digest == first
    assert load_scene(capture.root, views=NAMES[:3]).digest != first
    capture.write_json("split.json", {"test": ["v000", "v008"]})
    second = load_scene(capture.root).digest
    capture.picture("v004", 45).write_bytes(capture.picture("v004", 90).read_bytes())
    assert len({first, second, load_scene(capture.root).digest}) == 3


def test_records_are_frozen(capture: TinyCapture) -> None:
    scene = load_scene(capture.root)
    with pytest.raises(FrozenInstanceError):
        scene.name = "other"  # type: ignore[misc]


def test_unknown_view_names_its_neighbors(capture: TinyCapture) -> None:
    scene = load_scene(capture.root)
    with pytest.raises(PolarguideError, match=r"one of the 9 views, found 'v0O4'.*v004"):
        scene.view("v0O4")
    with pytest.raises(PolarguideError, match=r"\(views\).*found 'v04'.*v004"):
        load_scene(capture.root, views=["v000", "v04"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"downscale": 0}, "downscale: expected a whole number from 1 up, found 0"),
        ({"downscale": 1.5}, "found 1.5"),
        ({"downscale": True}, "found True"),
        ({"downscale": 11}, "downscale: expected at most 10 for pictures of 12x10, found 11"),
        ({"transfer": "gamma"}, "transfer: expected 'linear' or 'srgb', found 'gamma'"),
        ({"views": []}, "views: expected at least one view name, found an empty list"),
    ],
)
def test_arguments_out_of_range(capture: TinyCapture, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(PolarguideError, match=message):
        load_scene(capture.root, **arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("split.json", "{", r"split.json: expected a JSON file, found broken JSON"),
        ("split.json", "[]", r"split.json: expected a JSON object \{...\}, found \[\]"),
        ("split.json", '{"tests": []}', r"split.json: expected the field test, found only tests\."),
        ("split.json", '{"test": [3]}', r"split.json \(test\[0\]\): expected text, found 3.*\{\"test\""),
        ("split.json", '{"test": ["v000", "v0010"]}', r"split.json \(test\).*found 'v0010'.*v001"),
        ("scene.json", '{"refractive_index": 0.5}', r"scene.json \(refractive_index\).*above 1.*found 0.5"),
        ("scene.json", '{"refractive_index": "glass"}', 'found "glass"'),
        ("scene.json", '{"refractive_index": true}', "a number or null, found true"),
        ("scene.json", "\ufeff\ufeff", "broken JSON"),
    ],
)
def test_broken_side_files(capture: TinyCapture, name: str, text: str, message: str) -> None:
    (capture.root / name).write_text(text, encoding="utf-8")
    with pytest.raises(PolarguideError, match=message):
        load_scene(capture.root)


def test_all_views_in_the_test_set(capture: TinyCapture) -> None:
    capture.write_json("split.json", {"test": list(NAMES)})
    with pytest.raises(PolarguideError, match="at least one view to train on, found all 9 views"):
        load_scene(capture.root)
