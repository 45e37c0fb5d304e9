"""The schema of results.json: what is written passes, and what is wrong is named."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from comparison_records import results, run

from polarguide.errors import PolarguideError
from polarguide.experiments.results import read_results, validate_results, write_results
from polarguide.experiments.tables import scores_section, shown_columns

STORED = Path(__file__).parents[2] / "benchmarks" / "results"


@pytest.fixture
def record() -> dict[str, Any]:
    return results([run("x", "a", 0, psnr=30.0), run("y", "a", 0, psnr=31.0)])


def test_what_is_written_passes(record: dict[str, Any], tmp_path: Path) -> None:
    write_results(tmp_path / "results.json", record)
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]
    assert read_results(tmp_path / "results.json") == record


PART = {"material": None, "pixels": 3, "views": 1, "metrics": {}}


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("format",), "other", "(format): expected polarguide-results-2, found "),
        (("provenance", "date"), None, "(provenance.date): expected text, found null"),
        (("provenance", "commit"), 3, "(provenance.commit): expected text or null, found 3"),
        (("settings", "steps"), "10", "(settings.steps): expected a whole number, found "),
        (("settings", "seeds"), True, "(settings.seeds): expected a whole number, found true"),
        (("settings", "against"), "c", "(settings.against): expected one of the recipes a, found "),
        (("scenes",), [], "(scenes): expected a list"),
        (("scenes", 1, "name"), "x", "(scenes): expected every name once, found ["),
        (("recipes", 0, "data"), [], "(recipes[0].data): expected a JSON object {...}, found []"),
        (("runs", 0, "seed"), -1, "(runs[0].seed): expected 0 or more, found -1"),
        (("scenes", 0, "views"), -6, "(scenes[0].views): expected 0 or more, found -6"),
        (("scenes", 0, "black_share"), -5.0, "(scenes[0].black_share): expected 0 to 1, found -5.0"),
        (
            ("runs", 0, "objects", "o"),
            PART | {"pixels": -1},
            "(runs[0].objects[...].pixels): expected 0 or more",
        ),
        (
            ("runs", 0, "materials", "m"),
            PART | {"views": -1},
            "(runs[0].materials[...].views): expected 0 or more",
        ),
        (("runs", 0, "scene"), "z", "(runs[0].scene): expected one of the scenes x, y, found "),
        (("runs", 1, "state"), "lost", "(runs[1].state): expected one of done, failed, missing, found "),
        (("runs", 1, "state"), "failed", "(runs[1].metrics): expected values for a run that is done"),
        (("runs", 0, "metrics", "psnr"), "high", "(runs[0].metrics[...]): expected a number or null"),
        (("runs", 0, "views", "v0", "ssim"), "x", "(runs[0].views[...][...]): expected a number or null"),
        (("table", 0, "scene"), "y", "(table): expected a row for each of 3 scenes and recipes"),
        (("table", 2, "cells", "psnr", "mean"), "x", "(table[2].cells[...].mean): expected a number or null"),
        (("table", 0, "cells", "fps"), None, "(table[0].cells[...]): expected a JSON object {...}"),
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
    assert f"results.json {said}" in str(error.value)


def test_a_missing_key_is_named(record: dict[str, Any]) -> None:
    del record["runs"][0]["folder"]
    with pytest.raises(PolarguideError, match=r"runs\[0\]\): expected the field folder"):
        validate_results(record)
    with pytest.raises(PolarguideError, match="expected a JSON object"):
        validate_results(None)


def test_numbers_in_a_file_are_finite(record: dict[str, Any], tmp_path: Path) -> None:
    record["settings"]["refractive_index"] = float("nan")
    (tmp_path / "results.json").write_text(json.dumps(record))
    with pytest.raises(PolarguideError, match=r"results\.json"):
        read_results(tmp_path / "results.json")


@pytest.mark.parametrize("path", sorted(STORED.rglob("*.json")), ids=lambda path: path.stem)
def test_stored_results_are_read_and_shown(path: Path) -> None:
    stored = read_results(path)
    assert len(scores_section(stored).blocks) == len(stored["scenes"]) + (len(stored["scenes"]) > 1)


def test_a_record_of_the_version_before_is_completed(tmp_path: Path) -> None:
    record = results([run("x", "r", 0, psnr=30.0), run("x", "r:unpolarized", 0, psnr=28.0)])
    former = copy.deepcopy(record) | {"format": "polarguide-results-1"}
    del former["differences"], former["settings"]["against"], former["scenes"][0]["black_share"]
    for item in former["runs"]:
        del item["objects"], item["materials"]
    path = tmp_path / "results.json"
    path.write_text(json.dumps(former))
    record["scenes"][0]["black_share"] = None
    assert read_results(path) == record
    assert [d["mean"] for d in record["differences"]] == [2.0]


@pytest.mark.parametrize("key", ["settings", "scenes", "runs"])
@pytest.mark.parametrize("value", [None, 3, "x", [3]])
def test_a_broken_record_of_the_version_before_is_named(key: str, value: object, tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps({**results([run("x", "r", 0)]), "format": "polarguide-results-1", key: value}))
    with pytest.raises(PolarguideError, match=rf"results\.json \({key}"):
        read_results(path)


def test_a_record_from_before_a_metric_has_no_value_of_it(record: dict[str, Any]) -> None:
    for row in record["table"]:
        del row["cells"]["ssim"]
    validate_results(record)
    assert "SSIM" not in [column.label for column in shown_columns(record)]
