"""Charts: training curves, scores over the number in which a family of scenes differs, and over pictures taken."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from comparison_records import results, run

from polarguide.experiments.charts import (
    curves_svg,
    exposure_svg,
    read_curve,
    read_study,
    smoothed,
    study_svg,
    ticks,
)

SVG = "{http://www.w3.org/2000/svg}"
FAMILY = results(
    [run(f"views-{n}", r, 0, psnr=20.0 + n * k) for n in (9, 18, 36) for k, r in enumerate(("3dgs", "a<b"))]
)


def drawn(values: tuple[float, ...], parameter: str = "views") -> ElementTree.Element:
    text = study_svg(FAMILY, {s: (parameter, v) for s, v in zip(FAMILY.scenes, values, strict=True)})
    assert text is not None
    return ElementTree.fromstring(text)


def words(root: ElementTree.Element, tag: str = "text") -> list[str]:
    return [element.text or "" for element in root.iter(f"{SVG}{tag}")]


def test_a_family_is_drawn() -> None:
    root = drawn((9.0, 18.0, 36.0))
    assert len(list(root.iter(f"{SVG}polyline"))) == 2  # nothing is known about normals: one panel
    assert len(list(root.iter(f"{SVG}circle"))) == 6
    assert "a<b, views 36: 56.00" in words(root, "title")
    assert {"training views", "PSNR (dB) ↑", "3dgs", "a<b"} <= set(words(root))


@pytest.mark.parametrize(("values", "at_zero"), [((1.3, 1.5, 1.7), False), ((0.1, 1.5, 1.7), True)])
def test_the_axis_starts_at_zero_only_where_that_is_near(values: tuple[float, ...], at_zero: bool) -> None:
    assert ("0" in words(drawn(values, "index"))) is at_zero


@pytest.mark.parametrize(
    "studies", [(("views", 9.0), None), (("views", 9.0), ("noise", 1.0)), (("views", 9.0), ("views", 9.0))]
)
def test_what_is_not_a_family_is_not_drawn(studies: tuple[tuple[str, float] | None, ...]) -> None:
    assert study_svg(FAMILY, dict(zip(FAMILY.scenes, studies, strict=False))) is None


def test_the_number_is_read_from_the_scene(tmp_path: Path) -> None:
    assert read_study(tmp_path) is None
    (tmp_path / "scene.json").write_text(json.dumps({"study": {"parameter": "noise", "value": 2}}))
    assert read_study(tmp_path) == ("noise", 2.0)
    (tmp_path / "scene.json").write_text("{")
    assert read_study(tmp_path) is None


def test_the_chart_of_exposures_has_a_point_for_each_row() -> None:
    keys = ("psnr_foreground", "normal_mae_deg", "specular_psnr", "diffuse_psnr")
    found = results([run("cup", name, 0, **dict.fromkeys(keys, 20.0)) for name in ("four", "one")])
    text = exposure_svg(found, {("cup", "four"): 252, ("cup", "one"): 63})
    assert text is not None
    root = ElementTree.fromstring(text)
    assert words(root, "title").count("cup, four, 252 pictures: 20.00") == 4
    shown = words(root)
    assert shown.index("one") < shown.index("63") < shown.index("four") < shown.index("252")


def test_a_log_becomes_a_curve(tmp_path: Path) -> None:
    rows = [{"step": 10 * i + 9, "seconds": i / 2, "psnr": 20.0 + i} for i in range(1000)]
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 3')
    curve = read_curve(tmp_path, "a")
    assert curve is not None
    assert (curve.steps[0], curve.steps[-1], curve.seconds[-1]) == (10, 10000, 499.5)
    assert len(curve.psnr) <= 240
    np.testing.assert_allclose(curve.psnr, 20 + (curve.steps - 10) / 10)  # a line stays one under smoothing
    assert 'aria-label="PSNR over steps"' in curves_svg([curve], "steps")
    assert read_curve(tmp_path / "none", "a") is None


def test_smoothing_keeps_the_mean_of_noise_and_both_ends() -> None:
    values = np.random.default_rng(0).normal(25.0, 1.0, 2000)
    smooth = smoothed(values, 0.05)
    assert smooth[100:-100].std() < 0.2
    assert (smooth[0], smooth[-1]) == pytest.approx((values[0], values[-1]))


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 60, [0, 10, 20, 30, 40, 50, 60]),
        (18.3, 21.2, [18, 18.5, 19, 19.5, 20, 20.5, 21, 21.5]),
        (5, 5, [5, 5.0000002]),
    ],
)
def test_ticks_are_round_and_enclose(low: float, high: float, expected: list[float]) -> None:
    assert ticks(low, high) == expected
