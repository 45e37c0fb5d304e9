"""Each fault of the pictures is flagged by its own check and by no other; a sound capture is not flagged."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import gained, one_view, write_scene
from tiny_capture import encode_srgb

from polarguide.capture.angle_evidence import PAIRINGS
from polarguide.geometry.polarizer import ANGLES
from polarguide.inspection.capture import measure_view, read_capture
from polarguide.inspection.picture_checks import find_pairing, picture_checks
from polarguide.inspection.settings import Check


def checked(root: Path) -> dict[str, Check]:
    capture = read_capture(root)
    measurements = [measure_view(view, 1.5) for view in capture.views]
    return {check.key: check for check in picture_checks(capture, measurements, find_pairing(capture))}


def flagged(found: dict[str, Check]) -> dict[str, str]:
    return {key: check.verdict for key, check in found.items() if check.verdict != "ok"}


def test_a_sound_capture_is_not_flagged(tmp_path) -> None:
    found = checked(write_scene(tmp_path / "s"))
    assert flagged(found) == {}
    assert all(check.remedy == "" for check in found.values())
    assert abs(found["exposure"].figures["pair_ratio"] - 1) < 1e-3
    assert abs(found["encoding"].figures["curvature"]) < 0.02


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (encode_srgb, {"encoding": "wrong"}),
        (lambda v: v**1.6, {"encoding": "wrong"}),
        (gained(1.05, 1, 1, 1), {"exposure": "warning"}),
        (gained(1, 1.05, 1, 1), {"exposure": "warning"}),
        (gained(1, 1, 1.05, 1), {"exposure": "warning"}),
        (gained(1, 1, 1, 1.05), {"exposure": "warning"}),
        (gained(1.008, 1, 1, 1), {}),
        (gained(1.13, 1, 1, 1), {"exposure": "wrong", "pair_sums": "wrong"}),
    ],
)
def test_a_fault_is_flagged_by_its_check(tmp_path, change, expected) -> None:
    found = checked(write_scene(tmp_path / "s", change))
    got = flagged(found)
    for key, verdict in expected.items():
        assert got.get(key) == verdict, found[key].finding
        assert found[key].remedy
    others = got.keys() - expected.keys()
    # A gamma also disturbs the sums a little; nothing else may be called wrong for it.
    assert all(got[key] != "wrong" for key in others), got
    if all(key == "exposure" for key in expected):
        assert not others


@pytest.mark.parametrize(
    ("gamma", "verdict"),
    [(0.95, "ok"), (0.9, "warning"), (0.8, "warning"), (0.7, "wrong"), (1.05, "ok"), (1.12, "warning")],
)
def test_the_curvature_tells_the_gamma(tmp_path, gamma: float, verdict: str) -> None:
    check = checked(write_scene(tmp_path / "s", lambda v: v**gamma))["encoding"]
    assert check.verdict == verdict, check.finding
    assert check.figures["curvature"] == pytest.approx((1 - 1 / gamma) / 2, rel=0.15, abs=2e-3)


@pytest.mark.parametrize(("stops", "verdict"), [(0.05, "ok"), (0.2, "warning"), (1 / 3, "wrong")])
def test_exposures_that_leave_the_pair_sums_alike_are_measured(tmp_path, stops: float, verdict: str) -> None:
    """0 degrees by half of it longer, 90 degrees by half of it shorter: the ratio of the pair sums stays 1."""
    longer = 2 ** (stops / 2)
    check = checked(write_scene(tmp_path / "s", gained(longer, 1, 1 / longer, 1)))["exposure"]
    assert abs(check.figures["pair_ratio"] - 1) < 0.02  # a warning at most
    assert check.verdict == verdict, check.finding
    if verdict != "ok":
        assert check.figures["exposures"] == pytest.approx([longer, 1, 1 / longer, 1], rel=0.02)


def test_dark_and_unscaled_files_are_flagged(tmp_path) -> None:
    found = checked(write_scene(tmp_path / "s", lambda v: v * 0.004))
    assert found["noise"].verdict == "wrong"
    assert "not scaled" in found["saturation"].remedy


def test_saturation_is_flagged_with_its_views(tmp_path) -> None:
    root = write_scene(tmp_path / "s", lambda v: v * 0.9)
    one_view(root, lambda v: v * 2.2)
    check = checked(root)["saturation"]
    assert check.verdict == "warning"
    assert check.views == ("v1",)
    assert checked(write_scene(tmp_path / "t", lambda v: v * 4))["saturation"].verdict == "wrong"


def test_a_sound_capture_on_black_is_not_flagged(tmp_path) -> None:
    def on_black(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:, :, :50] = 0.0  # five eighths of every picture
        return values

    root = write_scene(tmp_path / "s", on_black)
    found = checked(root)
    assert flagged(found) == {}
    assert found["saturation"].figures["saturated"] == 0.0
    assert found["saturation"].figures["dark"] == pytest.approx(5 / 8, abs=0.01)
    # As prepare writes it: black pixels are marked invalid.
    (root / "invalid").mkdir()
    for index in range(3):
        invalid = np.zeros((60, 80), np.uint8)
        invalid[:, :50] = 255
        assert cv2.imwrite(str(root / "invalid" / f"v{index}.png"), invalid)
    assert flagged(checked(root)) == {}


def test_noise_is_flagged(tmp_path) -> None:
    rng = np.random.default_rng(0)
    found = checked(write_scene(tmp_path / "s", lambda v: v + rng.normal(0, 0.05, v.shape)))
    assert found["noise"].verdict == "warning"
    assert found["noise"].figures["noise_share"] == pytest.approx(0.05 / np.sqrt(3) / 0.3, rel=0.35)


def test_unpolarized_light_is_flagged_and_its_encoding_not_judged(tmp_path) -> None:
    found = checked(write_scene(tmp_path / "s", lambda v: v.mean(axis=0, keepdims=True).repeat(4, 0)))
    assert found["low_dolp"].verdict == "wrong"
    assert found["encoding"].verdict == "n/a"


@pytest.mark.parametrize("share", [0.0, 0.04])
def test_a_reversed_or_missing_filter_is_suspected(tmp_path, share: float) -> None:
    """Reversed, a circular polarizer of a real plate leaves a few percent of the modulation."""
    rng = np.random.default_rng(3)

    def reversed_filter(values: np.ndarray) -> np.ndarray:
        mean = values.mean(axis=0, keepdims=True)
        return mean + share * (values - mean) + rng.normal(0, 1e-3, values.shape)

    check = checked(write_scene(tmp_path / "s", reversed_filter))["low_dolp"]
    assert check.verdict == "wrong"
    assert "No modulation: was the filter reversed, or missing?" in check.finding
    assert "LCD screen" in check.remedy


def test_noise_in_the_dark_does_not_hide_a_reversed_filter(tmp_path) -> None:
    rng = np.random.default_rng(4)

    def noisy(values: np.ndarray) -> np.ndarray:
        mean = values.mean(axis=0, keepdims=True).repeat(4, 0)
        mean[:, :, : mean.shape[2] // 8] *= 0.05
        return mean + rng.normal(0, 1, values.shape) * np.sqrt(mean / 12_000)

    check = checked(write_scene(tmp_path / "s", noisy))["low_dolp"]
    assert check.figures["p99_dolp"] > 0.05
    assert "No modulation: was the filter reversed, or missing?" in check.finding


def test_weak_polarization_is_no_reversed_filter(tmp_path) -> None:
    def weak(values: np.ndarray) -> np.ndarray:
        mean = values.mean(axis=0, keepdims=True)
        return mean + 0.1 * (values - mean)

    check = checked(write_scene(tmp_path / "s", weak))["low_dolp"]
    assert check.verdict == "warning"
    assert "filter reversed" not in check.finding


def test_one_view_with_another_exposure_is_named(tmp_path) -> None:
    root = write_scene(tmp_path / "s", views=5)
    one_view(root, gained(1.04, 1, 1, 1))
    check = checked(root)["exposure"]
    assert check.verdict == "warning"
    assert check.views == ("v1",)


@pytest.mark.parametrize("pairing", [1, 2])
def test_files_of_another_pairing_are_named(tmp_path, pairing: int) -> None:
    files = PAIRINGS[pairing]
    root = write_scene(tmp_path / "s", lambda v: v[[ANGLES.index(angle) for angle in files]])
    found = checked(root)
    assert found["pair_sums"].verdict == "wrong"
    assert found["pair_sums"].figures["pairing"] == list(files)
    assert found["encoding"].verdict == found["exposure"].verdict == "n/a"


def test_light_that_changed_between_the_shots_is_flagged(tmp_path) -> None:
    root = write_scene(tmp_path / "s")
    shade = np.ones((4, 1, 80, 1))
    shade[0, 0, :, 0] += 0.3 * np.linspace(-1, 1, 80)
    one_view(root, lambda v: v * shade)
    check = checked(root)["pair_sums"]
    assert check.verdict == "warning"
    assert check.views == ("v1",)
