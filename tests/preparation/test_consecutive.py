"""Shots of one place in a row, ordinary photographs without a word, frames of a video, and the pairs to compare."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_files import behind, busy_light, write_picture
from faults import Fault
from heard import Heard
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from polarguide.capture.colmap.sfm import run_step
from polarguide.capture.filter.camera_files import Lens, camera_groups
from polarguide.capture.filter.shots import (
    chosen_matching,
    shots_of_one_place,
)
from polarguide.capture.layout import numbered_like_angles
from polarguide.core.progress import Advance, Reporter
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

PLAIN = PrepareSettings(poses="none", gains="none")
PLACES = 8


def glossy(place: int) -> np.ndarray:
    """Light of a place, with a DoLP up to 0.3."""
    return busy_light(96, 128, place) * np.array([1, 0.5, 0.5])[:, None, None, None]


def write_shots_in_a_row(folder: Path, angles: tuple[float, ...]) -> list[Path]:
    """JPEG files with running numbers, as many in a row as there are angles."""
    rng = np.random.default_rng(0)
    paths = []
    for place in range(PLACES):
        for shot in behind(glossy(place), angles):
            path = folder / f"DSC_{len(paths) + 1:04d}.jpg"
            write_picture(path, np.clip(shot + rng.normal(0, 0.003, shot.shape), 0, 1), bits=8)
            paths.append(path)
    return paths


@pytest.mark.parametrize("angles", [(0, 45, 90, 135), (0, 60, 120), (0, 90), (0,)])
def test_shots_of_one_place_are_counted(tmp_path: Path, angles: tuple[float, ...]) -> None:
    found = shots_of_one_place(write_shots_in_a_row(tmp_path, angles))
    assert found == (len(angles) if len(angles) > 1 else None)


@pytest.mark.parametrize("given", [None, 4])
def test_four_shots_in_a_row_become_one_view(tmp_path: Path, given: int | None) -> None:
    write_shots_in_a_row(tmp_path / "in", (90, 45, 0, 135))
    settings = replace(PLAIN, angles="90,45,0,135", shots_per_view=given, align=False, transfer="linear")
    heard = Heard()
    done = prepare_scene(tmp_path / "in", tmp_path / "out", settings, heard)
    assert done.views == [f"DSC_{4 * k + 1:04d}" for k in range(PLACES)]
    assert any("consecutive pictures show one place" in text for text in heard.said) == (given is None)
    truth = behind(glossy(0), (0, 45, 90, 135))
    for angle, expected in zip((0, 45, 90, 135), truth, strict=True):
        picture = cv2.imread(
            str(tmp_path / "out" / "polar" / f"DSC_0001_{angle:03d}.png"), cv2.IMREAD_UNCHANGED
        )
        assert np.median(np.abs(picture[..., ::-1] / 65535 - expected)) < 0.01


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({}, Fault(expected="the angles of shots", found="groups of 4", remedy="--shots-per-view 4")),
        ({"angles": "0,60"}, Fault("--angles", expected="4 angles", found="0,60")),
        (
            {"angles": "0,60", "shots_per_view": 4},
            Fault("--angles", expected="one angle or 4", found="2 angles"),
        ),
        (
            {"angles": "0,60,120", "shots_per_view": 3},
            Fault("--angles", expected="divisible by 3", found="32 in"),
        ),
        ({"shots_per_view": 4}, Fault("--shots-per-view", expected="--angles")),
    ],
)
def test_shots_in_a_row_without_fitting_angles_are_refused(
    tmp_path: Path, changes: dict[str, Any], fault: Fault
) -> None:
    write_shots_in_a_row(tmp_path / "in", (0, 45, 90, 135))
    fault.raised_by(prepare_scene, tmp_path / "in", tmp_path / "out", replace(PLAIN, **changes))


def test_every_picture_alone_is_said(tmp_path: Path) -> None:
    write_shots_in_a_row(tmp_path / "in", (0,))
    heard = Heard()
    done = prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, angles="0,45,90,135"), heard)
    assert len(done.views) == PLACES
    assert any("Every picture is a view of its own" in text for text in heard.said)


def colored(bits: int) -> np.ndarray:
    return (np.random.default_rng(0).uniform(0, 1, (48, 64, 3)) * (2**bits - 1)).astype(f"u{bits // 8}")


@pytest.mark.parametrize(
    ("suffix", "pixels"),
    [
        ("jpg", colored(8)),
        ("png", colored(8)),
        ("png", colored(16)),
        ("tif", colored(16)),
        ("jpg", colored(8)[..., 0]),  # mosaics are no JPEG files
    ],
)
def test_pictures_without_a_sign_of_a_filter_are_photographs(
    tmp_path: Path, suffix: str, pixels: np.ndarray
) -> None:
    (tmp_path / "in").mkdir()
    for name in "abc":
        assert cv2.imwrite(str(tmp_path / "in" / f"{name}.{suffix}"), pixels)
    heard = Heard()
    prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN, heard)
    assert any("ordinary photographs" in text for text in heard.said)
    assert (tmp_path / "out" / "polar" / "a_none.png").exists()


@pytest.mark.parametrize("name", ["cup_P{}", "cup({})", "{}_cup", "cup_{}°", "x1_polar{:03d}_linear"])
def test_pictures_numbered_like_angles_are_no_photographs(tmp_path: Path, name: str) -> None:
    """Names that no rule reads, of four pictures that differ in 0, 45, 90 and 135 alone."""
    for place, angle in enumerate((0, 45, 90, 135)):
        write_picture(tmp_path / "in" / f"{name.format(angle)}.png", busy_light(48, 64, place)[0] / 2)
    Fault(found="angles in another form").raised_by(prepare_scene, tmp_path / "in", tmp_path / "out", PLAIN)
    done = prepare_scene(tmp_path / "in", tmp_path / "out", replace(PLAIN, angles="none"))
    assert len(done.views) == 4


@pytest.mark.parametrize("numbers", [range(0, 200, 45), range(45, 200, 45), range(0, 100, 45)])
def test_numbers_that_go_on_count_pictures(numbers: range) -> None:
    assert numbered_like_angles([Path(f"shots/frame_{number:04d}.jpg") for number in numbers]) == []


@pytest.mark.parametrize("suffix", ["png", "tif", "bmp"])
@pytest.mark.parametrize("channels", [1, 3])
def test_gray_pictures_may_be_mosaics(tmp_path: Path, suffix: str, channels: int) -> None:
    (tmp_path / "in").mkdir()
    gray = np.repeat(colored(8)[..., :1], channels, axis=2)
    for name in "abc":
        assert cv2.imwrite(str(tmp_path / "in" / f"{name}.{suffix}"), gray)
    fault = Fault(expected="photographs in color", found="a." + suffix, remedy="--angles none")
    fault.raised_by(prepare_scene, tmp_path / "in", tmp_path / "out", PLAIN)


def write_video(path: Path, frames: int = 60) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    light = (255 * np.clip(busy_light(96, 256, 1)[0] / 2, 0, 1)).astype(np.uint8)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 12, (128, 96))
    for number in range(frames):
        frame = light[:, 2 * number : 2 * number + 128]
        video.write(np.ascontiguousarray(cv2.GaussianBlur(frame, (0, 0), 4) if number % 3 else frame))
    video.release()


@pytest.mark.parametrize("named", [True, False])
def test_frames_of_a_video_are_photographs(tmp_path: Path, named: bool) -> None:
    video = tmp_path / "in" / "walk.mp4"
    write_video(video)
    heard = Heard()
    source = video if named else tmp_path / "in"
    done = prepare_scene(source, tmp_path / "out", PLAIN, heard)
    assert len(done.views) == 24
    assert any("24 frames of walk.mp4" in text for text in heard.said)
    sharpness = [
        cv2.Laplacian(cv2.imread(str(path)), cv2.CV_32F).var()
        for path in sorted((tmp_path / "out-frames").glob("*.png"))
    ]
    assert np.mean(np.array(sharpness) > 0.5 * max(sharpness)) > 0.7  # a third of the video is sharp
    assert not prepare_scene(source, tmp_path / "out", PLAIN).new


def test_a_video_beside_pictures_is_named(tmp_path: Path) -> None:
    write_shots_in_a_row(tmp_path / "in", (0,))
    write_video(tmp_path / "in" / "walk.mp4")
    heard = Heard()
    assert len(prepare_scene(tmp_path / "in", tmp_path / "out", PLAIN, heard).views) == PLACES
    assert any("Not used: walk.mp4" in text for text in heard.said)


def test_a_broken_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "walk.mp4").write_bytes(b"nothing")
    Fault(expected="a video that OpenCV reads").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", PLAIN
    )


@pytest.mark.parametrize(
    ("name", "count", "matching", "chosen"),
    [
        ("IMG_{:04d}", 72, "auto", "exhaustive"),
        ("IMG_{:04d}", 160, "auto", "sequential"),
        ("IMG_{:04d}", 160, "exhaustive", "exhaustive"),
        ("frame_{:04d}", 72, "auto", "sequential"),
        ("frame_{:04d}", 24, "auto", "exhaustive"),
        ("{:04d}x", 160, "auto", "exhaustive"),
    ],
)
def test_the_pairs_to_compare_follow_from_order_and_number(
    name: str, count: int, matching: str, chosen: str
) -> None:
    heard = Heard()
    assert chosen_matching([name.format(k) for k in range(count)], matching, heard) == chosen
    assert bool(heard.said) == (matching == "auto" and count > 40)


def test_lenses_are_told_apart_by_their_focal_lengths(tmp_path: Path) -> None:
    stated = {"a": 26.0, "b": 26.1, "c": 41.0, "d": 26.0}
    paths = {}
    for view, focal in stated.items():
        paths[view] = tmp_path / f"{view}.jpg"
        exif = Image.Exif()
        exif[272] = "Phone"
        exif.get_ifd(0x8769)[37386] = IFDRational(round(10 * focal), 10)
        Image.new("RGB", (8, 8)).save(paths[view], exif=exif)
    found = camera_groups(paths)
    assert found["a"] == found["b"] == found["d"] == Lens("Phone (lens)", 26.0)
    assert found["c"] == Lens("Phone (lens)", 41.0)
    assert camera_groups({view: paths[view] for view in "abd"}) == {}


@pytest.mark.parametrize(("first", "second", "cameras"), [(0, 1, 0), (0, 2, 2), (1, 1.5, 2), (2, 2, 0)])
@pytest.mark.parametrize("film", [None, 26])
def test_digital_zoom_is_another_camera(
    tmp_path: Path, first: float, second: float, cameras: int, film: int | None
) -> None:
    """Whatever the focal lengths beside it; 0 means that there was none."""
    paths = {}
    for view, zoom in (("a", first), ("b", second)):
        paths[view] = tmp_path / f"{view}.jpg"
        exif = Image.Exif()
        tags = exif.get_ifd(0x8769)
        tags[37386], tags[41988] = IFDRational(42, 10), IFDRational(round(10 * zoom), 10)
        if film:
            tags[41989] = film
        Image.new("RGB", (8, 8)).save(paths[view], exif=exif)
    assert len(set(camera_groups(paths).values())) == cameras


class Impatient(Reporter):
    """Interrupts whatever it is told of."""

    def track(self, label: str, total: int | None = None):
        return self

    def __enter__(self) -> Advance:
        def advance(done: int, **_: Any) -> None:
            raise KeyboardInterrupt

        return advance

    def __exit__(self, *_: object) -> None:
        return None


def test_a_step_of_colmap_ends_with_the_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = tmp_path / "waiting.py"
    waiting.write_text("import sys\nsys.stdin.read()\n")  # the input stays open as long as the call lasts
    monkeypatch.setitem(run_step.__globals__, "_PROGRAM", waiting)
    started = []
    popen = run_step.__globals__["subprocess"].Popen
    monkeypatch.setattr(
        run_step.__globals__["subprocess"],
        "Popen",
        lambda *a, **k: started.append(popen(*a, **k)) or started[-1],
    )
    with pytest.raises(KeyboardInterrupt):
        run_step("match", {}, 0, Impatient(), "matching")
    assert [process.returncode for process in started] == [-9]


def test_a_step_that_fails_is_one_line(tmp_path: Path) -> None:
    arguments = {"start": str(tmp_path), "database": "x", "images": "x", "out": str(tmp_path)}
    Fault("triangulating", expected="COLMAP to succeed").raised_by(
        run_step, "triangulate", arguments, 0, Reporter(), "triangulating"
    )
