"""Where files are looked for, and what is said when they are missing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from tiny_capture import TinyCapture, write_picture

from polarguide.capture import load_scene
from polarguide.capture.layout import refuse_scene
from polarguide.errors import PolarguideError
from polarguide.polarizer import ANGLES


@pytest.mark.parametrize(
    "folders",
    [
        ("I-00", "I-45", "I-90", "I-135"),
        ("0", "45", "90", "135"),
        ("000", "045", "090", "135"),
        ("I_0", "I_45", "I_90", "I_135"),
        ("pol000", "pol045", "pol090", "pol135"),
        ("0deg", "45deg", "90deg", "135deg"),
    ],
)
def test_one_folder_per_angle_reads_the_same(
    capture: TinyCapture, folders: tuple[str, str, str, str]
) -> None:
    expected = load_scene(capture.root)
    capture.to_folders(folders)
    (capture.root / "180").mkdir()
    scene = load_scene(capture.root)
    assert [view.name for view in scene.views] == [view.name for view in expected.views]
    for view, other in zip(scene.views, expected.views, strict=True):
        assert torch.equal(view.codes, other.codes)


def fails(root: Path, *parts: str) -> None:
    """``load_scene`` raises one error whose message holds all parts, in order."""
    with pytest.raises(PolarguideError, match=".*".join(re.escape(part) for part in parts)):
        load_scene(root)


def test_no_such_folder(tmp_path: Path) -> None:
    fails(tmp_path / "nowhere", "nowhere", "a capture folder", "found nothing", "polar/<view>_000.png")


def test_a_file_instead_of_a_folder(capture: TinyCapture) -> None:
    fails(capture.picture("v000", 0), "v000_000.png", "a capture folder", "found a file")


def test_a_folder_without_pictures(tmp_path: Path) -> None:
    fails(tmp_path, "found an empty folder", "I-00, I-45")
    (tmp_path / "images").mkdir()
    fails(tmp_path, "found a folder with images", "I-00, I-45")
    (tmp_path / "polar").mkdir()
    fails(tmp_path, "pictures of at least one view, found none")


def test_missing_angle(capture: TinyCapture) -> None:
    capture.picture("v003", 45).unlink()
    fails(capture.root, "polar/v003_045.png", "view v003 at 45 degrees", "found only 0, 90, 135 degrees.")
    capture.picture("v005", 90).unlink()
    fails(capture.root, "polar/v003_045.png", "(2 views are incomplete)", "Add the file")


def test_missing_angle_in_folders(capture: TinyCapture) -> None:
    capture.to_folders(("I-00", "I-45", "I-90", "I-135"))
    (capture.root / "I-90" / "v002.png").unlink()
    fails(capture.root, "I-90/v002.png", "view v002 at 90 degrees", "found only 0, 45, 135 degrees")


def test_missing_angle_folder(capture: TinyCapture) -> None:
    capture.to_folders(("I-00", "I-45", "I-90", "polarizer135"))
    fails(capture.root, "four folders", "none for 135 degrees beside I-00, I-45, I-90", "Add the folder")


def test_two_folders_for_one_angle(capture: TinyCapture) -> None:
    capture.to_folders(("I-00", "I-45", "I-90", "I-135"))
    (capture.root / "45").mkdir()
    fails(capture.root, "one folder for 45 degrees", "found 45 and I-45", "Remove or rename")


def test_two_files_for_one_picture(capture: TinyCapture) -> None:
    capture.picture("v001", 0, ".jpg").write_bytes(b"")
    fails(capture.root, "polar", "one file called v001_000", "found v001_000.jpg and v001_000.png")


def test_files_that_are_passed_over_are_reported_once(capture: TinyCapture) -> None:
    for name in ("preview.png", "v000_180.png", "v001_000_small.png"):
        write_picture(capture.root / "polar" / name, capture.linear["v000"][0])
    (capture.root / "polar" / "notes.txt").write_text("not a picture")
    (capture.root / "polar" / "._v000_000.png").write_bytes(b"")
    capture.write_truth("v000_gt")
    scene = load_scene(capture.root)
    assert len(scene.views) == 9
    assert scene.warnings == (
        "polar/ has pictures whose names do not end in _000, _045, _090 or _135, which are not used "
        "(preview.png, v000_180.png, v001_000_small.png).",
        "gt/ has files without a view, which are not used (v000_gt.npz): name each file like its view.",
    )


def test_view_names_may_contain_underscores_and_digits(capture: TinyCapture) -> None:
    for angle in ANGLES:
        capture.picture("v000", angle).rename(capture.picture("left_090", angle))
    images = capture.root / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace("v000.png", "cam/left_090.jpeg"))
    assert load_scene(capture.root).views[0].name == "left_090"


@pytest.mark.parametrize("place", ["", "polar", "polar/new/x", "masks", "gt", "sparse/0", "invalid/new"])
def test_nothing_is_written_into_a_scene(tmp_path: Path, place: str) -> None:
    scene = tmp_path / "scene"
    (scene / "polar").mkdir(parents=True)
    with pytest.raises(PolarguideError, match=r"expected a folder for what is written, found .*scene"):
        refuse_scene(scene / place)
    (tmp_path / "link").symlink_to(scene / place)
    with pytest.raises(
        PolarguideError, match=r"found (polar|masks|gt|sparse|invalid)/ of a scene|found a scene"
    ):
        refuse_scene(tmp_path / "link")
    refuse_scene(tmp_path / "polar" / "new")
    refuse_scene(scene / "runs" / "mine")  # nothing is read from there


def test_four_folders_of_angles_are_a_scene_too(tmp_path: Path) -> None:
    for angle in ("I-00", "I-45", "I-90", "I-135"):
        (tmp_path / angle).mkdir()
    for place in (tmp_path, tmp_path / "I-45", tmp_path / "I-45" / "new"):
        with pytest.raises(PolarguideError, match="expected a folder for what is written"):
            refuse_scene(place)
