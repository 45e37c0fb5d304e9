"""Scenes that ``synth`` renders come back through ``prepare``: by the command that it prints at its end."""

import csv
import json
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.ndimage
import torch
from started_mitsuba import started_mitsuba

from polarguide import optics
from polarguide.capture import load_scene
from polarguide.capture.colmap.model import read_model
from polarguide.cli.app import run
from polarguide_synth.sensor import Sensor, behind_filter
from polarguide_synth.settings import start_mitsuba
from tests.synth.test_scene_folder import TINY


@pytest.fixture
def polarguide(capsys: pytest.CaptureFixture[str]) -> Iterator[Callable[..., str]]:
    """Runs a command line that ends well; returns what it prints."""
    started_mitsuba()

    def run_and_read(*arguments: str) -> str:
        assert run(list(arguments)) == 0
        return capsys.readouterr().out

    yield run_and_read
    start_mitsuba(threads=1)


@pytest.mark.parametrize("sensor", ["imx250mzr", "IMX250MYR"])
def test_mosaics_come_back_through_prepare(
    sensor: str, tmp_path: Path, polarguide: Callable[..., str]
) -> None:
    """As a user goes: by the command that ``synth`` prints at its end; compared with the truth of the same paths."""
    out = tmp_path / "scene"
    ground, ball = TINY["things"]
    # Dark, so that reflections polarize its light.
    things = [ground, {**ball, "material": {"color": [0.04, 0.05, 0.03]}}]
    dark = {**TINY, "camera": {**TINY["camera"], "views": 2}, "things": things}
    (tmp_path / "dark.json").write_text(json.dumps(dark))
    wishes = ["--sensor", sensor, "--size", "48x48", "--samples", "32", "--threads", "1"]
    printed = polarguide("synth", str(tmp_path / "dark.json"), "--out", str(out), *wishes)
    command = printed.partition("next: polarguide ")[2].splitlines()[0]
    polarguide(*shlex.split(command), "--gains", "none")
    prepared = load_scene(Path(f"{out}-prepared"))
    for mine, other in zip(load_scene(out).test_views, prepared.test_views, strict=True):
        assert (other.name, other.camera.fx) == (mine.name, pytest.approx(mine.camera.fx))
        with np.load(out / "gt" / f"{mine.name}.npz") as ground_truth:
            light, ball = (
                torch.from_numpy(ground_truth["stokes"]).float(),
                torch.from_numpy(ground_truth["objid"]) == 2,
            )
        ball = torch.from_numpy(scipy.ndimage.binary_erosion(ball.numpy(), iterations=4))
        usable = ball & ~other.invalid & ~other.saturated
        found, known = optics.stokes(other.intensities()), light
        if sensor == "imx250mzr":
            found, known = found.mean(-1, keepdim=True), known.mean(-1, keepdim=True)
        # Full scale has room for the largest gain, so that the pictures are darker by the smallest.
        found, known = found[:, usable] / min(Sensor().gains), known[:, usable]
        np.testing.assert_allclose(
            found[0].mean(0), known[0].mean(0), rtol=0.008
        )  # 0.012 without calibration
        assert ((found[1:] - known[1:]) / known[0]).abs().median() < 0.02
        strong = optics.dolp(known) > 0.1
        assert strong.sum() > 100
        turn = torch.remainder(optics.aolp(found) - optics.aolp(known) + np.pi / 2, np.pi) - np.pi / 2
        assert torch.rad2deg(turn[strong]).abs().median() < 2.5


def test_photographs_through_a_filter_come_back_through_prepare(
    tmp_path: Path, polarguide: Callable[..., str]
) -> None:
    """By the command that ``synth`` prints; the pictures are what a sheet before the lens passes of the light."""
    out = tmp_path / "scene"
    (tmp_path / "tiny.json").write_text(json.dumps(TINY))
    wishes = [
        "--sensor",
        "filter",
        "--size",
        "48x32",
        "--samples",
        "32",
        "--threads",
        "1",
        "--ground-truth",
        "all",
    ]
    printed = polarguide("synth", str(tmp_path / "tiny.json"), "--out", str(out), *wishes)
    command = printed.partition("next: polarguide ")[2].splitlines()[0]
    polarguide(*shlex.split(command))
    made = json.loads((out / "scene.json").read_text())["shots"]
    rows = list(csv.DictReader((Path(f"{out}-prepared") / "angles.csv").read_text().splitlines()))
    assert [(row["view"], float(row["angle"])) for row in rows] == [(n, s["angle"]) for n, s in made.items()]
    stops = np.log2([float(row["gain"]) for row in rows])
    known = np.array([shot["stops"] for shot in made.values()])
    assert np.abs(stops - (known - known.mean())).max() < 0.05
    assert {shot["orientation"] for shot in made.values()} - {1}
    model = read_model(out)
    for row in rows:
        with np.load(out / "gt" / f"{row['view']}.npz") as ground_truth:
            stokes = ground_truth["stokes"].astype(float)
        rays = model.camera(row["view"]).rays(dtype=torch.float64).numpy()
        light = behind_filter(stokes, rays, float(row["angle"])) * 2 ** made[row["view"]]["stops"]
        stored = cv2.imread(str(Path(f"{out}-prepared") / "polar" / row["file"]), cv2.IMREAD_UNCHANGED)
        picture = stored[..., ::-1] / 65535
        assert picture.shape == light.shape
        assert np.median(np.abs(picture - light)[light < 0.9]) < 0.01
