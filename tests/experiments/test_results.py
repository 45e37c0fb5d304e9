"""The schema of results.json: what is written passes, and what is wrong is named."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from comparison_records import results, run

from polarguide.errors import PolarguideError
from polarguide.experiments.results import validate_results, write_results


@pytest.fixture
def record() -> dict[str, Any]:
    return results([run("x", "a", 0, psnr=30.0), run("y", "a", 0, psnr=31.0)])


def test_what_is_written_passes(record: dict[str, Any], tmp_path: Path) -> None:
    write_results(tmp_path / "results.json", record)
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]
    read = json.loads((tmp_path / "results.json").read_text())
    validate_results(read)
    assert read == record


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("format",), "other", "results.json: format: expected polarguide-results-1, found 'other'"),
        (("provenance", "date"), None, "provenance.date: expected text, found None"),
        (("provenance", "commit"), 3, "provenance.commit: expected text or null, found 3"),
        (("settings", "steps"), "10", "settings.steps: expected a whole number, found '10'"),
        (("settings", "seeds"), True, "settings.seeds: expected a whole number, found True"),
        (
            ("settings", "refractive_index"),
            float("nan"),
            "settings.refractive_index: expected a number, found nan",
        ),
        (("scenes",), [], "scenes: expected a list that is not empty, found []"),
        (("scenes", 1, "name"), "x", "scenes: expected every name once, found ['x', 'x']"),
        (("recipes", 0, "data"), [], "recipes[0].data: expected an object, found []"),
        (("runs", 0, "scene"), "z", "runs[0].scene: expected one of the scenes x, y, found 'z'"),
        (("runs", 1, "state"), "lost", "runs[1].state: expected one of done, failed, missing, found 'lost'"),
        (("runs", 1, "state"), "failed", "runs[1].metrics: expected values for a run that is done"),
        (("runs", 0, "metrics", "psnr"), "high", "runs[0].metrics.psnr: expected a finite number or null"),
        (("runs", 0, "views", "v0", "ssim"), float("inf"), "runs[0].views.v0.ssim: expected a finite number"),
        (("table", 0, "scene"), "y", "table: expected a row for each of 3 scenes and recipes"),
        (("table", 2, "cells", "psnr", "mean"), "x", "table[2].cells.psnr.mean: expected a number or null"),
        (("table", 0, "cells", "fps"), None, "table[0].cells.fps: expected an object, found None"),
    ],
)
def test_what_is_wrong_is_named(
    record: dict[str, Any], path: tuple[Any, ...], value: object, said: str
) -> None:
    broken = copy.deepcopy(record)
    place: Any = broken
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(PolarguideError) as error:
        validate_results(broken)
    assert said in str(error.value)


def test_a_missing_key_is_named(record: dict[str, Any]) -> None:
    del record["runs"][0]["folder"]
    with pytest.raises(PolarguideError, match=r"runs\[0\].folder: expected text, found 'no such key'"):
        validate_results(record)
    with pytest.raises(PolarguideError, match="expected an object, found None"):
        validate_results(None)
