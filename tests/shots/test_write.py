"""The files of a shot: pictures, numbers, units and the page."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from faults import Fault

import polarguide
from polarguide import optics
from polarguide.capture.exposures import FOUR
from polarguide.core.options import SceneOptions
from polarguide_shots.exposures import find_shots
from polarguide_shots.maps import Reason, ShotMaps
from polarguide_shots.options import ShotOptions
from polarguide_shots.read import SurfaceMaps, parse_intrinsics, read_shot, surface_maps
from polarguide_shots.write import KINDS, PAGE, drawn, stretch_of, with_legend, write_shots
from tests.helpers.browsers import chromium
from tests.helpers.heard import Heard
from tests.helpers.tiny_capture import NAMES, write_tiny_capture
from tests.shots.test_read import CUP, MONO, PLAIN, light, write_four, write_mosaic

KIND = {kind.key: kind for kind in KINDS}


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> tuple[ShotMaps, SurfaceMaps]:
    maps = read_shot(write_four(tmp_path_factory.mktemp("four"), CUP), PLAIN)
    return maps, surface_maps(maps)


def test_numbers_and_their_units(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    paths = write_four(tmp_path / "in", CUP)
    done = write_shots(paths, tmp_path / "out", PLAIN, formats=("npy", "exr"))
    folder = tmp_path / "out" / "cup"
    assert done.folders == {"cup": folder}
    record = json.loads((folder / "maps.json").read_text())
    assert record["maps"].keys() == KIND.keys()
    s0, s1, s2 = light()
    np.testing.assert_allclose(np.load(folder / "DoLP.npy"), np.hypot(s1, s2) / s0, atol=1e-3)
    assert np.load(folder / "S0.npy").shape == (*s0.shape, 3)
    for key, kind in KIND.items():
        array = np.load(folder / f"{key}.npy")
        with exr.File(str(folder / f"{key}.exr")) as file:
            assert file.header()["unit"] == kind.unit == record["maps"][key]["unit"]
            (channel,) = file.channels().values()
            np.testing.assert_array_equal(np.asarray(channel.pixels), array.astype(np.float32))
    assert not list(folder.glob("*.png"))


def test_pictures_have_a_legend_at_full_size(read: tuple[ShotMaps, SurfaceMaps], tmp_path: Path) -> None:
    maps, surface = read
    for kind in KINDS:
        values = kind.values(maps, surface)
        stretch = stretch_of(kind, values, maps)
        plain = drawn(kind, values, maps, stretch)
        assert plain.shape[:2] == maps.reason.shape
        whole = with_legend(plain, kind, stretch, maps.name)
        np.testing.assert_array_equal(whole[: plain.shape[0], : plain.shape[1]], plain)
        legend = whole[plain.shape[0] :]
        assert (legend < 128).any()


def test_a_weak_polarization_is_stretched_to_be_seen(read: tuple[ShotMaps, SurfaceMaps]) -> None:
    maps, _ = read
    weak = (maps.dolp / 50).astype(np.float32)
    stretch = stretch_of(KIND["DoLP"], weak, maps)
    assert 0.01 <= stretch.high <= 0.012
    assert f"0 to {stretch.high:g}" in stretch.text
    assert drawn(KIND["DoLP"], weak, maps, stretch).max() > 200


def test_one_bad_file_does_not_stop_the_others(tmp_path: Path) -> None:
    for name in "abc":
        write_mosaic(tmp_path / f"{name}.png")
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:500])
    heard = Heard()
    done = write_shots([tmp_path], tmp_path / "out", MONO, formats=("npy",), reporter=heard)
    assert list(done.folders) == ["a", "c"]
    assert list(done.faults) == ["b"]
    assert any("b.png" in text and "cut short" in text for text in heard.said)
    assert not (tmp_path / "out" / "b").exists()


def test_wrong_format(tmp_path: Path) -> None:
    Fault("formats", "some of png, exr, npy, page", "pdf").raised_by(
        write_shots, [tmp_path], tmp_path / "out", formats=("pdf",)
    )


def test_a_scene_with_poses_keeps_its_pictures_and_gets_maps_on_demand(tmp_path: Path) -> None:
    scene = polarguide.demo_scene()
    sheet = polarguide.priors(scene, tmp_path, views="v000", formats=["npy"])
    assert sheet == tmp_path / "contact_sheet.png"
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["v000"]
    assert json.loads((tmp_path / "v000" / "maps.json").read_text())["rays"] == "of a pinhole camera"
    Fault(expected="shots", found="a scene with poses").raised_by(
        polarguide.priors, scene, tmp_path / "x", shots=ShotOptions(sensor="IMX250MZR")
    )


def test_what_is_written_is_of_the_views_of_the_scene_that_is_given(demo_scene: Path, tmp_path: Path) -> None:
    """Not of the files in its folder: a view may have another mask, other pictures, or another frame of its angles."""
    scene = polarguide.load_scene(demo_scene, downscale=4, views=["v000", "v011"])
    view = scene.view("v000")
    mask = torch.zeros_like(view.invalid)
    mask[:, 10:] = True
    stokes = view.stokes()
    half = view.changed(lambda codes: (codes.int() // 2).to(torch.uint16))
    changed = {
        "masked": replace(view, mask=mask).masked(),
        "darker": half,
        "filter": replace(view, mount="filter"),
    }
    maps = {}
    for name, other in changed.items():
        given = replace(scene, views=(other, scene.view("v011")))
        polarguide.priors(given, tmp_path / name, views="v000", formats=["npy"])
        maps[name] = {
            key: np.load(tmp_path / name / "v000" / f"{key}.npy") for key in ("S0", "DoLP", "reason")
        }
        expected = optics.luminance(other.stokes())
        np.testing.assert_allclose(maps[name]["S0"].mean(axis=-1), expected[0], atol=1e-4)
        np.testing.assert_allclose(maps[name]["DoLP"][:, 10:], optics.dolp(expected)[:, 10:], atol=2e-3)
    assert (maps["masked"]["reason"][:, :10] == Reason.MASKED).all()
    assert not (maps["masked"]["reason"][:, 10:] == Reason.MASKED).all()
    np.testing.assert_allclose(maps["darker"]["S0"], stokes[0] / 2, atol=1e-3)
    one = replace(scene, views=tuple(view.changed(lambda codes: codes[:1], FOUR[:1]) for view in scene.views))
    Fault("view v000", expected="pictures at three or more different angles").raised_by(
        polarguide.priors, one, tmp_path / "one", views="v000", formats=["npy"]
    )
    assert not (tmp_path / "one").exists()


@pytest.mark.parametrize("bits", [8, 16])
def test_pixels_of_a_view_say_what_those_of_its_files_say(tmp_path: Path, bits: int) -> None:
    tiny = write_tiny_capture(tmp_path / "tiny")
    for name in NAMES:
        values = tiny.linear[name].copy()
        values[:, 2, :5], values[1, 4, :6] = 0, 1
        tiny.write_view(name, values, bits=bits)
    view = polarguide.load_scene(tiny.root).view("v000")
    (shot,) = (found for found in find_shots([tiny.root]) if found.view == "v000")
    ours, theirs = read_shot(view), read_shot(shot)
    for name in ("intensities", "stokes", "dolp", "aolp", "reason"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    assert ours.noise == theirs.noise
    assert (ours.reason[2, :5] == Reason.DARK).all()
    assert (ours.reason[4, :6] == Reason.SATURATED).all()


def test_the_page_asks_for_nothing_and_escapes_names(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "<b>part.png")
    done = write_shots([tmp_path / "<b>part.png"], tmp_path / "out", MONO, formats=("page",))
    text = (done.folders["<b>part"] / PAGE).read_text()
    assert "<b>part" not in text
    assert "&lt;b&gt;part" in text
    assert not re.search(r"(?:src|href)\s*=\s*[\"']?(?:https?:|//|file:)", text)
    assert "default-src 'none'" in text


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (390, 844)])
def test_values_under_the_pointer(tmp_path: Path, width: int, height: int) -> None:
    write_mosaic(tmp_path / "part.png")
    folder = write_shots([tmp_path / "part.png"], tmp_path / "out", MONO, formats=("page",)).folders["part"]
    maps = read_shot(tmp_path / "part.png", MONO)
    with chromium() as browser:
        page = browser.new_page(viewport={"width": width, "height": height})
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda message: problems.append(message.text))
        page.goto((folder / PAGE).as_uri())
        page.wait_for_function("planes !== null")
        box = page.locator("#map").bounding_box()
        page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
        said = page.inner_text("#values")
        found = re.search(r"pixel\s*(\d+), (\d+)", said)
        assert found is not None
        x, y = int(found[1]), int(found[2])
        degree = re.search(r"DoLP\s*([\d.]+) ± ([\d.]+)", said)
        angle = re.search(r"AoLP\s*([\d.]+)°", said)
        assert degree is not None
        assert angle is not None
        assert float(degree[1]) == pytest.approx(maps.dolp[y, x], abs=1e-4)
        assert float(degree[2]) == pytest.approx(maps.sigma_dolp[y, x], rel=0.1)
        assert float(angle[1]) == pytest.approx(np.rad2deg(maps.aolp[y, x]), abs=0.1)
        first = page.get_attribute("#map", "src")
        page.click("[data-layer='1']")
        assert page.get_attribute("#map", "src") != first
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert not problems
        page.close()


def test_a_color_shot_is_drawn_in_color(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "part.png", "IMX250MYR")
    options = ShotOptions(sensor="IMX250MYR", bits=12)
    folder = write_shots([tmp_path / "part.png"], tmp_path / "out", options, formats=("png",)).folders["part"]
    picture = cv2.imread(str(folder / "S0.png"))[:64, :96].astype(int)
    assert (picture[..., 1] - picture[..., 2]).mean() > 10  # green filters pass more than red ones


def test_maps_that_cannot_be_written_do_not_stop_the_other_shots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for name in "abc":
        write_mosaic(folder / f"{name}.png", "IMX250MZR")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").write_text("a file where a folder should be")
    write = np.save

    def full(file: Any, values: Any) -> None:
        if f"{os.sep}b{os.sep}" in file.name:
            raise MemoryError
        write(file, values)

    monkeypatch.setattr(np, "save", full)
    heard = Heard()
    done = write_shots([folder], tmp_path / "out", MONO, formats=("npy",), reporter=heard)
    assert set(done.folders) == {"c"}
    assert set(done.faults) == {"a", "b"}
    assert "memory" in done.faults["b"].found
    assert (tmp_path / "out" / "c" / "maps.json").exists()


def test_maps_are_not_written_beside_their_mosaic_or_among_shots(tmp_path: Path) -> None:
    (tmp_path / "S0").mkdir()
    mosaic = tmp_path / "S0" / "S0.png"
    write_mosaic(mosaic, "IMX250MZR")
    before = mosaic.read_bytes()
    Fault(found="a file inside").raised_by(write_shots, [mosaic], tmp_path, MONO, formats=("png",))
    Fault(found="the folder of the shots").raised_by(
        write_shots, [tmp_path / "S0"], tmp_path / "S0" / ".." / "S0", MONO, formats=("png",)
    )
    assert mosaic.read_bytes() == before
    assert [path.name for path in (tmp_path / "S0").iterdir()] == ["S0.png"]


def test_maps_of_a_scene_have_the_size_that_is_asked_for(tmp_path: Path, demo_scene: Path) -> None:
    reading = SceneOptions(downscale=4)
    polarguide.priors(demo_scene, tmp_path, views="v000", reading=reading, formats=["npy"])
    assert np.load(tmp_path / "v000" / "DoLP.npy").shape == (24, 32)
    assert np.load(tmp_path / "v000" / "normal.npy").shape == (24, 32, 3)


def test_a_view_that_does_not_fit_into_memory_is_refused_by_its_header(
    tmp_path: Path, demo_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (found, *_) = find_shots([demo_scene])
    monkeypatch.setattr("polarguide.capture.layout.free_memory", lambda: 1 << 20)
    monkeypatch.setattr("polarguide_shots.read.read_view", lambda *_, **__: pytest.fail("it was decoded"))
    Fault(found="a view of 128x96 that take").raised_by(read_shot, found, ShotOptions())


def test_intrinsics_are_those_of_the_picture(tmp_path: Path) -> None:
    assert parse_intrinsics("50,50,32,24", (64, 48)).fx == 50
    for text in ("1e308,1e308,0,0", "50,50,1e9,0", "50,50,32,-481", "0,50,32,24"):
        Fault("--intrinsics").raised_by(parse_intrinsics, text, (64, 48))


def test_maps_are_not_written_through_a_link_that_leads_out(tmp_path: Path) -> None:
    write_mosaic(tmp_path / "in.png", "IMX250MZR")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "in").symlink_to(tmp_path / "elsewhere")
    Fault(expected="a place in", found="a link to").raised_by(
        write_shots, [tmp_path / "in.png"], tmp_path / "out", MONO, formats=("npy",)
    )
    assert not list((tmp_path / "elsewhere").iterdir())
