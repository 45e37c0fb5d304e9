"""The schema of results.json: what is written passes, and what is wrong is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from comparison_records import content, results, run

from polarguide.core.errors import PolarguideError
from polarguide.core.records import decode
from polarguide.experiments.record import Record, read_results
from polarguide.experiments.results import Results
from polarguide.experiments.tables import scores_section
from polarguide.experiments.writing import write_tables

STORED = Path(__file__).parents[2] / "benchmarks" / "results"
PART = {"material": None, "pixels": 3, "views": 1, "metrics": {}}


def two() -> dict[str, Any]:
    return content([run("x", "a", 0, psnr=30.0), run("y", "a", 0, psnr=31.0)])


def test_what_is_written_passes(tmp_path: Path) -> None:
    found = results([run("x", "r", 0, psnr=30.0), run("x", "r:unpolarized", 0, psnr=28.0)])
    write_tables(tmp_path, found)
    assert read_results(tmp_path / "results.json") == found.record
    written = json.loads((tmp_path / "results.json").read_text())
    assert written["table"][0]["cells"]["psnr"] == {"mean": 30.0, "spread": None, "count": 1}
    assert [(d["metric"], d["mean"]) for d in written["differences"]] == [("psnr", 2.0)]


@pytest.mark.parametrize(
    ("path", "value", "where", "expected"),
    [
        (("format",), "other", "format", "one of polarguide-results-2, polarguide-results-1"),
        (("provenance", "date"), None, "provenance.date", "text"),
        (("provenance", "commit"), 3, "provenance.commit", "text or null"),
        (("settings", "steps"), "10", "settings.steps", "a whole number"),
        (("settings", "seeds"), True, "settings.seeds", "a whole number"),
        (("settings", "against"), "c", "settings.against", "one of a"),
        (("settings",), [3], "settings", "a JSON object {...}"),
        (("scenes",), [], "scenes", "a list"),
        (("scenes", 1, "name"), "x", "scenes", "every name once"),
        (("recipes", 0, "data"), [], "recipes[0].data", "a JSON object {...}"),
        (("runs", 0, "seed"), -1, "runs[0].seed", "0 or more"),
        (("scenes", 0, "views"), -6, "scenes[0].views", "0 or more"),
        (("scenes", 0, "black_share"), -5.0, "scenes[0].black_share", "0 to 1"),
        (("runs", 0, "objects", "o"), PART | {"pixels": -1}, "runs[0].objects[...].pixels", "0 or more"),
        (("runs", 0, "materials", "m"), PART | {"views": -1}, "runs[0].materials[...].views", "0 or more"),
        (("runs", 0, "scene"), "z", "runs[0].scene", "one of x, y"),
        (("runs", 1, "state"), "lost", "runs[1].state", "done, failed or missing"),
        (
            ("runs", 1, "state"),
            "failed",
            "runs[1].metrics",
            "values for a run that is done and null for another",
        ),
        (("runs", 0, "metrics", "psnr"), "high", "runs[0].metrics[...]", "a number or null"),
        (("runs", 0, "views", "v0", "ssim"), "x", "runs[0].views[...][...]", "a number or null"),
        (("runs",), 3, "runs", "a list"),
    ],
)
def test_what_is_wrong_is_named(path: tuple[Any, ...], value: object, where: str, expected: str) -> None:
    broken = two()
    place: Any = broken
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(PolarguideError) as error:
        decode(broken, Record, "results.json")
    assert error.value.where == f"results.json ({where})"
    assert error.value.expected.startswith(expected)


def test_a_missing_key_and_numbers_that_are_not_finite_are_named(tmp_path: Path) -> None:
    record = two()
    del record["runs"][0]["folder"]
    with pytest.raises(PolarguideError, match=r"runs\[0\]\): expected the field folder"):
        decode(record, Record, "results.json")
    record = two()
    record["settings"]["refractive_index"] = float("nan")
    (tmp_path / "results.json").write_text(json.dumps(record))
    with pytest.raises(PolarguideError, match=r"results\.json"):
        read_results(tmp_path / "results.json")


@pytest.mark.parametrize("path", sorted(STORED.rglob("*.json")), ids=lambda path: path.stem)
def test_stored_results_are_read_and_shown(path: Path) -> None:
    stored = Results(read_results(path))
    assert len(scores_section(stored).blocks) == len(stored.scenes) + (len(stored.scenes) > 1)


def test_a_record_of_the_version_before_is_completed(tmp_path: Path) -> None:
    former = two() | {"format": "polarguide-results-1"}
    del former["settings"]["against"], former["scenes"][0]["black_share"]
    for item in former["runs"]:
        del item["objects"], item["materials"], item["metrics"]["ssim"]
    former["settings"]["refractive_index"] = 0.0
    (tmp_path / "results.json").write_text(json.dumps(former))
    read = read_results(tmp_path / "results.json")
    assert (read.format, read.settings.against, read.runs[0].objects) == ("polarguide-results-2", None, {})
    assert read.settings.refractive_index is None
    assert [scene.black_share for scene in read.scenes] == [None, 0.0]
    assert not any("SSIM" in heading for heading in scores_section(Results(read)).headings)
