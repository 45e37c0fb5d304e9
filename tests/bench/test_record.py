"""The schema of results.json: what is written passes, and what is wrong is named."""

import json
from pathlib import Path
from typing import Any

import pytest
from comparison_records import content, results, run, unfinished
from faults import Fault

from polarguide.core.records import decode
from polarguide_bench.join import join_records, join_tables
from polarguide_bench.results import Record, Results, read_results
from polarguide_bench.tables import scores_section, write_tables

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
        (("format",), "other", "format", "one of polarguide-results-2"),
        (("provenance", "date"), None, "provenance.date", "text"),
        (("provenance", "commit"), 3, "provenance.commit", "text or null"),
        (("settings", "steps"), "10", "settings.steps", "a whole number"),
        (("settings", "seeds"), True, "settings.seeds", "a whole number"),
        (("settings", "against"), "c", "settings.against", "one of a"),
        (("settings",), [3], "settings", "a JSON object {...}"),
        (("scenes",), [], "scenes", "a list"),
        (("scenes", 1, "name"), "x", "scenes", "no name more than once"),
        (("recipes", 0, "data"), [], "recipes[0].data", "a JSON object {...}"),
        (("runs", 0, "seed"), -1, "runs[0].seed", "0 or more"),
        (("scenes", 0, "views"), -6, "scenes[0].views", "0 or more"),
        (("runs", 0, "objects", "o"), PART | {"pixels": -1}, "runs[0].objects.o.pixels", "0 or more"),
        (("runs", 0, "materials", "m"), PART | {"views": -1}, "runs[0].materials.m.views", "0 or more"),
        (("runs", 0, "scene"), "z", "runs[0].scene", "one of x, y"),
        (("runs", 1, "state"), "lost", "runs[1].state", "done, failed or missing"),
        (
            ("runs", 1, "state"),
            "failed",
            "runs[1].metrics",
            "values for a finished run",
        ),
        (("runs", 0, "metrics", "psnr"), "high", "runs[0].metrics.psnr", "a number or null"),
        (("runs", 0, "views", "v0", "ssim"), "x", "runs[0].views.v0.ssim", "a number or null"),
        (("runs",), 3, "runs", "a list"),
    ],
)
def test_what_is_wrong_is_named(path: tuple[Any, ...], value: object, where: str, expected: str) -> None:
    broken = two()
    place: Any = broken
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    Fault(f"results.json ({where})", expected).raised_by(decode, broken, Record, "results.json")


def test_a_missing_key_and_numbers_that_are_not_finite_are_named(tmp_path: Path) -> None:
    record = two()
    del record["runs"][0]["folder"]
    Fault("runs[0])", "the field folder").raised_by(decode, record, Record, "results.json")
    record = two()
    record["settings"]["refractive_index"] = float("nan")
    (tmp_path / "results.json").write_text(json.dumps(record))
    Fault("results.json (settings.refractive_index)", "finite", "nan").raised_by(
        read_results, tmp_path / "results.json"
    )


@pytest.mark.parametrize("path", sorted(STORED.rglob("*.json")), ids=lambda path: path.stem)
def test_stored_results_are_read_and_shown(path: Path) -> None:
    stored = Results(read_results(path))
    assert len(scores_section(stored).blocks) == len(stored.scenes) + (len(stored.scenes) > 1)


def test_a_record_without_later_fields_is_completed(tmp_path: Path) -> None:
    former = two()
    del former["settings"]["against"]
    for item in former["runs"]:
        del item["objects"], item["materials"], item["metrics"]["ssim"]
    (tmp_path / "results.json").write_text(json.dumps(former))
    read = read_results(tmp_path / "results.json")
    assert (read.settings.against, read.runs[0].objects) == (None, {})
    assert not any("SSIM" in heading for heading in scores_section(Results(read)).headings)


RUNS = [
    run(scene, recipe, seed, psnr=30.0 + number + 0.3 * seed + 0.1 * seed * number)
    for scene in ("x", "y")
    for number, recipe in enumerate(("3dgs", "polarguide", "polarguide:unpolarized"))
    for seed in (0, 1)
]


def _part(**wanted: object) -> Record:
    return results([r for r in RUNS if all(r[key] == value for key, value in wanted.items())]).record


def _written(folder: Path, **wanted: object) -> Path:
    folder.mkdir()
    write_tables(folder, Results(_part(**wanted)))
    return folder


@pytest.mark.parametrize(
    "parts",
    [
        [{"scene": "x"}, {"scene": "y"}],
        [{"recipe": "3dgs"}, {"recipe": "polarguide"}, {"recipe": "polarguide:unpolarized"}],
        [
            {"scene": "x", "recipe": "3dgs"},
            {"scene": "x"},
            {"scene": "y", "seed": 0},
            {"scene": "y", "seed": 1},
        ],
    ],
)
def test_parts_joined_are_the_whole(parts: list[dict[str, object]]) -> None:
    made: dict[str, Record] = {}
    there: set[tuple[str, str, int]] = set()
    for wanted in parts:  # a run that is in an earlier part is not there yet in a later one
        of = [r for r in RUNS if all(r[key] == value for key, value in wanted.items())]
        places = [(r["scene"], r["recipe"], r["seed"]) for r in of]
        runs = [unfinished(*p) if p in there else r for p, r in zip(places, of, strict=True)]
        made[f"part {len(made)}"] = results(runs).record
        there.update(places)
    joined, whole = join_records(made), results(RUNS).record
    joined.settings.seeds = whole.settings.seeds  # the largest of a part, which is not that of the whole
    assert joined == whole
    assert not Results(joined).differences.empty


def test_a_missing_run_is_filled_and_a_doubled_one_refused() -> None:
    whole = _part(scene="x")
    empty = results([unfinished(r.scene, r.recipe, r.seed) for r in whole.runs]).record
    for parts in ({"a": empty, "b": whole}, {"a": whole, "b": empty}):
        assert {r.state for r in join_records(parts).runs} == {"done"}
    Fault("b", "", "x, 3dgs, seed 0 once more").raised_by(join_records, {"a": whole, "b": _part(scene="x")})


@pytest.mark.parametrize(
    ("path", "value", "where"),
    [
        (("settings", "steps"), 20, "b (settings.steps)"),
        (("provenance", "version"), "2", "b (provenance.version)"),
        (("provenance", "sources"), "def", "b (provenance.sources)"),
        (("scenes", 0, "digest"), "e" * 64, "b (scene x, digest)"),
        (("scenes", 0, "test_views"), ["v1"], "b (scene x, test_views)"),
        (("recipes", 0, "data"), {"steps": 1}, "b (recipe 3dgs)"),
    ],
)
def test_what_does_not_belong_together_is_refused(path: tuple[Any, ...], value: object, where: str) -> None:
    part, other = _part(scene="x", seed=0), _part(scene="x", seed=1)
    place: Any = other
    for key in path[:-1]:
        place = place[key] if isinstance(key, int) else getattr(place, key)
    setattr(place, path[-1], value)
    Fault(where).raised_by(join_records, {"a": part, "b": other})


def test_compilers_may_differ_but_not_the_commit() -> None:
    parts = {scene: _part(scene=scene) for scene in ("x", "y")}
    for name, record in parts.items():
        record.provenance.commit, record.provenance.sources = "c" * 40, name
    assert join_records(parts).provenance.sources == "x; y"
    parts["y"].provenance.commit = "d" * 40
    Fault("y (provenance.sources)").raised_by(join_records, parts)


def test_files_and_that_a_part_is_not_written_over(tmp_path: Path) -> None:
    x, y = (_written(tmp_path / scene, scene=scene) for scene in ("x", "y"))
    joined = join_tables([x, y / "results.json"], tmp_path / "all", against="3dgs")
    assert read_results(tmp_path / "all" / "results.json") == joined.record
    assert {"results.md", "results.csv", "results.tex", "differences.csv", "report.html"} <= {
        path.name for path in (tmp_path / "all").iterdir()
    }
    assert "Pictures are in the reports of the parts." in (tmp_path / "all" / "report.html").read_text()
    before = (y / "results.json").read_bytes()
    Fault(expected="joined records").raised_by(join_tables, [x, y], y)
    assert (y / "results.json").read_bytes() == before


def test_half_a_character_in_a_name_is_written_as_its_escape(tmp_path: Path) -> None:
    write_tables(tmp_path, results([run("s\ud800", "a", 0, psnr=20.0)]))
    join_tables([tmp_path / "results.json"], tmp_path / "new")
    assert "\\ud800" in (tmp_path / "new/results.md").read_text()
