"""Records of parts of a comparison, joined: what one comparison of all would have written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from comparison_records import results, run, unfinished

from polarguide.core.errors import PolarguideError
from polarguide.experiments.join import join_records, join_tables
from polarguide.experiments.record import Record, read_results
from polarguide.experiments.results import Results
from polarguide.experiments.writing import write_tables

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
    with pytest.raises(PolarguideError) as error:
        join_records({"a": whole, "b": _part(scene="x")})
    assert error.value.where == "b"
    assert error.value.found == "x, 3dgs, seed 0 once more"


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
    with pytest.raises(PolarguideError) as error:
        join_records({"a": part, "b": other})
    assert error.value.where == where


def test_compilers_may_differ_but_not_the_commit() -> None:
    parts = {scene: _part(scene=scene) for scene in ("x", "y")}
    for name, record in parts.items():
        record.provenance.commit, record.provenance.sources = "c" * 40, name
    assert join_records(parts).provenance.sources == "x; y"
    parts["y"].provenance.commit = "d" * 40
    with pytest.raises(PolarguideError) as error:
        join_records(parts)
    assert error.value.where == "y (provenance.sources)"


def test_files_and_that_a_part_is_not_written_over(tmp_path: Path) -> None:
    x, y = (_written(tmp_path / scene, scene=scene) for scene in ("x", "y"))
    joined = join_tables([x, y / "results.json"], tmp_path / "all", against="3dgs")
    assert read_results(tmp_path / "all" / "results.json") == joined.record
    assert {"results.md", "results.csv", "results.tex", "differences.csv", "report.html"} <= {
        path.name for path in (tmp_path / "all").iterdir()
    }
    assert "Pictures are in the reports of the parts." in (tmp_path / "all" / "report.html").read_text()
    before = (y / "results.json").read_bytes()
    with pytest.raises(PolarguideError) as error:
        join_tables([x, y], y)
    assert error.value.expected == "a folder of its own"
    assert (y / "results.json").read_bytes() == before


def test_half_a_character_in_a_name_is_written_as_its_escape(tmp_path: Path) -> None:
    write_tables(tmp_path, results([run("s\ud800", "a", 0, psnr=20.0)]))
    join_tables([tmp_path / "results.json"], tmp_path / "new")
    assert "\\ud800" in (tmp_path / "new/results.md").read_text()
