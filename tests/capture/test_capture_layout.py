"""The files of a capture, and what is warned of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import Fault
from tiny_capture import NAMES, TinyCapture, encode_srgb, write_picture

from polarguide.capture import checks, load_scene
from polarguide.capture.layout import refuse_scene
from polarguide.geometry.polarizer import ANGLES


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


def folders_without(place: str, *names: str) -> Callable[[TinyCapture], None]:
    """Move the pictures into folders of these names, and remove a file."""

    def damage(capture: TinyCapture) -> None:
        capture.to_folders(names or ("I-00", "I-45", "I-90", "I-135"))
        if place:
            (capture.root / place).unlink()

    return damage


def two_folders(capture: TinyCapture) -> None:
    folders_without("")(capture)
    (capture.root / "45").mkdir()


FAULTS: dict[str, tuple[Callable[[TinyCapture], object], Fault]] = {
    "no picture of an angle in its folder": (
        folders_without("I-90/v002.png"),
        Fault("I-90/v002.png", "view v002 at 90 degrees", "only 0, 45, 135 degrees"),
    ),
    "no folder of an angle": (
        folders_without("", "I-00", "I-45", "I-90", "polarizer135"),
        Fault(expected="four folders", found="none for 135", remedy="Add the folder"),
    ),
    "two folders of an angle": (
        two_folders, Fault(expected="one folder for 45 degrees", found="45 and I-45", remedy="Remove or rename")
    ),
    "two files of a picture": (
        lambda capture: capture.picture("v001", 0, ".jpg").write_bytes(b""),
        Fault("polar", "one file called v001_000", "v001_000.jpg and v001_000.png"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FAULTS)
def test_each_fault_of_a_layout_is_named(capture: TinyCapture, case: str) -> None:
    damage, fault = FAULTS[case]
    damage(capture)
    fault.raised_by(load_scene, capture.root)


def test_no_such_folder(capture: TinyCapture) -> None:
    Fault("nowhere", "a capture folder", "nothing", "polar/<view>_000.png").raised_by(
        load_scene, capture.root / "nowhere"
    )
    Fault("v000_000.png", "a capture folder", "a file").raised_by(load_scene, capture.picture("v000", 0))


def test_a_folder_without_pictures(tmp_path: Path) -> None:
    Fault(found="an empty folder", remedy="I-00, I-45").raised_by(load_scene, tmp_path)
    (tmp_path / "images").mkdir()
    Fault(found="a folder with images", remedy="I-00, I-45").raised_by(load_scene, tmp_path)
    (tmp_path / "polar").mkdir()
    Fault(expected="pictures of at least one view", found="none").raised_by(load_scene, tmp_path)


def test_missing_angle(capture: TinyCapture) -> None:
    capture.picture("v003", 45).unlink()
    Fault("polar/v003_045.png", "view v003 at 45 degrees", "only 0, 90, 135 degrees").raised_by(
        load_scene, capture.root
    )
    capture.picture("v005", 90).unlink()
    Fault("polar/v003_045.png", found="(2 views are incomplete)", remedy="Add the file").raised_by(
        load_scene, capture.root
    )


def test_files_that_are_passed_over_are_reported_once(capture: TinyCapture) -> None:
    for name in ("preview.png", "v000_180.png", "v001_000_small.png"):
        write_picture(capture.root / "polar" / name, capture.linear["v000"][0])
    (capture.root / "polar" / "notes.txt").write_text("not a picture")
    (capture.root / "polar" / "._v000_000.png").write_bytes(b"")
    capture.write_truth("v000_gt")
    scene = load_scene(capture.root)
    assert len(scene.views) == 9
    pictures, truth = scene.warnings
    assert "(preview.png, v000_180.png, v001_000_small.png)" in pictures
    assert "(v000_gt.npz)" in truth


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
    Fault(expected="an output folder", found="scene").raised_by(refuse_scene, scene / place)
    (tmp_path / "link").symlink_to(scene / place)
    Fault("link", "an output folder", "a scene").raised_by(refuse_scene, tmp_path / "link")
    refuse_scene(tmp_path / "polar" / "new")
    refuse_scene(scene / "runs" / "mine")  # nothing is read from there


def test_four_folders_of_angles_are_a_scene_too(tmp_path: Path) -> None:
    for angle in ("I-00", "I-45", "I-90", "I-135"):
        (tmp_path / angle).mkdir()
    for place in (tmp_path, tmp_path / "I-45", tmp_path / "I-45" / "new"):
        Fault(expected="an output folder").raised_by(refuse_scene, place)


def warnings_of(capture: TinyCapture, **arguments: str) -> tuple[str, ...]:
    return load_scene(capture.root, **arguments).warnings  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "order",
    [(0, 2, 1, 3), (3, 1, 2, 0), (0, 1, 3, 2), (1, 0, 2, 3)],
    ids=["45-90", "0-135", "90-135", "0-45"],
)
def test_swapped_files_are_found(capture: TinyCapture, order: tuple[int, ...]) -> None:
    capture.rewrite(lambda linear: linear[list(order)])
    (warning,) = warnings_of(capture)
    assert warning.startswith("I0 + I90 differs from I45 + I135 by ")
    assert "in 9 of 9 views (v000, v001, v002, v003 and 5 more)" in warning
    swapped = (
        "45 and 90 (or 0 and 135)" if order in ((0, 2, 1, 3), (3, 1, 2, 0)) else "90 and 135 (or 0 and 45)"
    )
    assert warning.endswith(f"The pictures at {swapped} degrees are probably swapped.")


def test_one_view_with_swapped_files_is_named(capture: TinyCapture) -> None:
    capture.write_view("v006", capture.linear["v006"][[0, 2, 1, 3]])
    (warning,) = warnings_of(capture)
    assert "in 1 of 9 views (v006)" in warning


def test_one_dimmer_picture_is_found(capture: TinyCapture) -> None:
    gains = np.array([1.0, 0.8, 1.0, 0.8])[:, None, None, None]
    capture.rewrite(lambda linear: linear * gains)
    warning = warnings_of(capture)[0]
    assert warning.startswith("I0 + I90 differs from I45 + I135 by 22.2% of S0")
    assert warning.endswith("Probably files are swapped, or the transfer is wrong.")


def test_gain_differences_of_real_sensors_pass(capture: TinyCapture) -> None:
    gains = np.array([0.99, 1.0, 0.98, 1.01])[:, None, None, None]
    capture.rewrite(lambda linear: linear * gains)
    assert warnings_of(capture) == ()


@pytest.mark.parametrize("bits", [8, 16])
def test_display_encoding_is_noticed(capture: TinyCapture, bits: int) -> None:
    capture.rewrite(encode_srgb, bits=bits)
    (warning,) = warnings_of(capture)
    assert warning.startswith("The pictures look sRGB-encoded (curvature -0.")
    assert "transfer srgb" in warning
    assert warnings_of(capture, transfer="srgb") == ()


def test_linear_pictures_read_as_srgb_are_noticed(capture: TinyCapture) -> None:
    warnings = warnings_of(capture, transfer="srgb")
    assert warnings[-1].startswith("The pictures look linear already (curvature 0.")
    assert warnings[-1].endswith("read them with transfer linear.")


def test_black_pictures(capture: TinyCapture) -> None:
    for name in NAMES[:2]:
        capture.write_view(name, capture.linear[name] * 0.005)
    capture.write_view("v002", np.zeros((4, 10, 12, 3)))
    (warning,) = warnings_of(capture)
    assert warning.startswith("3 of 9 views are almost black: 99% of their values are under 1% of full scale")
    assert "(v000, v001, v002)" in warning
    assert load_scene(capture.root).view("v002").saturated.all()


def test_saturated_pictures(capture: TinyCapture) -> None:
    capture.write_view("v004", np.clip(capture.linear["v004"] * 4.0, 0.0, 1.0))
    scene = load_scene(capture.root)
    (warning,) = scene.warnings
    assert warning.startswith("1 of 9 views are heavily saturated: up to ")
    assert "(v004)" in warning
    assert scene.view("v004").saturated.float().mean() > 0.3


@pytest.mark.parametrize(("bits", "factor"), [(10, 64), (12, 16)])
def test_bits_that_were_not_scaled(capture: TinyCapture, bits: int, factor: int) -> None:
    capture.rewrite(lambda linear: linear * (2**bits - 1) / 65535)
    (warning,) = warnings_of(capture)
    assert f"unscaled {bits}-bit data. Multiply the values by {factor}." in warning


def test_full_scale_below_the_largest_code(capture: TinyCapture) -> None:
    """Pictures quantized in steps of 64 saturate at 65472."""
    capture.rewrite(lambda linear: np.floor(np.clip(linear * 2.5, 0, 1) * 1023.99) * 64 / 65535)
    for view in load_scene(capture.root).views:
        clipped = (view.codes.numpy() == 65472).any(axis=(0, 3))
        assert 0.1 < clipped.mean() < 1.0
        np.testing.assert_array_equal(view.saturated.numpy(), clipped)


def histogram(**counts: int) -> np.ndarray:
    values = np.concatenate([np.full(count, int(code[1:])) for code, count in counts.items()])
    return checks.top_histogram(values.astype(np.uint16))


@pytest.mark.parametrize(
    ("counts", "scale"),
    [
        ({"c100": 5}, None),
        ({"c65535": 1}, 65535),
        ({"c65472": 30, "c65408": 2, "c65344": 4}, 65472),
        ({"c65472": 3, "c65408": 2}, None),
        ({"c65472": 2}, None),
        ({"c65000": 500}, None),
        ({"c65520": 40, "c65504": 3}, 65520),
    ],
)
def test_full_scale_needs_a_pile_at_the_top(counts: dict[str, int], scale: int | None) -> None:
    assert checks.full_scale(histogram(**counts), 65535) == scale


def test_full_scale_of_eight_bits() -> None:
    assert checks.full_scale(checks.top_histogram(np.array([3, 254, 254], np.uint8)), 255) is None
    assert checks.full_scale(checks.top_histogram(np.array([3, 254, 255], np.uint8)), 255) == 255


def test_curvature_needs_polarized_light() -> None:
    gray = np.full((4, 60, 60, 3), 30000, np.uint16)
    usable = np.ones((60, 60), bool)
    assert checks.curvature_of(checks.measure(gray, usable).slopes) is None
    assert checks.curvature_of(checks.measure(gray, ~usable).slopes) is None
