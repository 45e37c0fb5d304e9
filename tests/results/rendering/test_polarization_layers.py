"""Predicted polarization as layers of a run, beside what views measure."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from faults import Fault

import polarguide
from polarguide.results.rendering import pictures
from polarguide.runs.opened import OpenedRun
from polarguide.shading.result import POLARIZED


@pytest.fixture(scope="module")
def run(trained: Path) -> polarguide.Run:
    return polarguide.open_run(trained)


def test_they_are_what_the_model_predicts(run: polarguide.Run) -> None:
    assert run.layers[-3:] == POLARIZED
    layers = run.render("v000", POLARIZED)
    view = run.scene.view("v000")
    stokes = layers["stokes"].numpy()
    assert stokes.shape == tuple(view.stokes().shape)
    result = run.result("v000")
    assert torch.equal(layers["stokes"], run.model.stokes(result, view.camera))
    np.testing.assert_allclose(stokes[0] / 2, result.final.numpy(), atol=1e-5)
    s0, s1, s2 = stokes.mean(axis=-1)
    np.testing.assert_allclose(layers["dolp"], np.hypot(s1, s2) / np.maximum(s0, 1e-9), atol=2e-3)
    lit = np.hypot(s1, s2) > 1e-3
    turned = layers["aolp"].numpy() - np.arctan2(s2, s1) / 2
    assert np.abs(np.sin(turned))[lit].max() < 1e-3
    Fault(expected="dolp").raised_by(run.render, "v000", ["DoLP"])


def test_numbers_in_files(run: polarguide.Run, tmp_path: Path) -> None:
    layers = {name: values.numpy() for name, values in run.render("v000", POLARIZED).items()}
    for kind in ("npy", "exr"):
        run.write_pictures(tmp_path / kind, views="v000", layers=POLARIZED, format=kind)
    for name, values in layers.items():
        np.testing.assert_allclose(np.load(tmp_path / "npy" / f"v000_{name}.npy"), values, atol=1e-6)
    with OpenEXR.File(str(tmp_path / "exr" / "v000_stokes.exr")) as file:
        pixels = file.channels()["RGB"].pixels
    np.testing.assert_allclose(pixels, layers["stokes"].mean(axis=-1).transpose(1, 2, 0), atol=1e-5)
    assert {*json.loads((tmp_path / "npy" / "layers.json").read_text())} == {*POLARIZED}


def test_the_sheet_has_both_names_a_scale_each_and_no_empty_column(
    run: polarguide.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[list[str], list[object], str]] = []

    def contact_sheet(rows, names, columns, *, footer, caption):  # type: ignore[no-untyped-def]
        drawn.append((columns, footer, caption))
        return np.zeros((8, 8, 3), np.uint8)

    monkeypatch.setattr(pictures, "contact_sheet", contact_sheet)
    run.write_pictures(tmp_path, views="v000", layers=["final", "metalness", "depth", "dolp", "aolp"])
    ((columns, footer, caption),) = drawn
    assert columns[:2] == ["final", "photograph"]
    assert columns[-6:] == ["depth", "depth, true", "dolp", "dolp, measured", "aolp", "aolp, measured"]
    assert [cell is None for cell in footer] == [name in ("final", "photograph") for name in columns]
    assert "metalness" not in columns
    assert caption.endswith("left out as uniform: metalness")


def test_depths_have_many_colors_near_and_far(run: polarguide.Run, tmp_path: Path) -> None:
    run.write_pictures(tmp_path, views="v000", layers=["depth"])
    picture = cv2.imread(str(tmp_path / "v000_depth.png"))
    alpha = run.render("v000", ["alpha"])["alpha"].numpy()
    assert (picture[alpha < 0.4] == 0).all()
    colors, counts = np.unique(picture[alpha > 0.6], axis=0, return_counts=True)
    assert len(colors) > 40
    assert counts.max() < 0.2 * counts.sum()


def test_a_model_that_predicts_none_is_told(run: polarguide.Run) -> None:
    plain = OpenedRun.of(run)
    plain.model = type("Blind", (), {"render": run.model.render, "stokes": lambda *_: None})()
    Fault(found="dolp").raised_by(plain.render, "v000", ["dolp"])
