"""Records of parts of a comparison, joined: what one comparison of all would have written."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from comparison_records import results, run, unfinished

from polarguide.errors import PolarguideError
from polarguide.experiments.join import join_results, join_tables
from polarguide.experiments.results import read_results, write_results

RUNS = [
    run(scene, recipe, seed, psnr=30.0 + number + 0.3 * seed + 0.1 * seed * number)
    for scene in ("x", "y")
    for number, recipe in enumerate(("3dgs", "polarguide", "polarguide:unpolarized"))
    for seed in (0, 1)
]


def _part(**wanted: object) -> dict[str, Any]:
    return results([r for r in RUNS if all(r[key] == value for key, value in wanted.items())])


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
    made = [_part(**wanted) for wanted in parts]
    seen: set[tuple[str, str, int]] = set()
    for part in made:  # a run that is in an earlier part is not there yet in a later one
        for index, one in enumerate(part["runs"]):
            place = (one["scene"], one["recipe"], one["seed"])
            if place in seen:
                part["runs"][index] = unfinished(*place)
            seen.add(place)
    joined = join_results(made, [f"part {k}" for k in range(len(made))])
    whole = results(RUNS)
    for part in (joined, whole):
        part["settings"]["seeds"] = 0  # the largest of a part, which is not that of the whole
    assert joined == whole
    assert joined["differences"]


def test_a_missing_run_is_filled_and_a_doubled_one_refused() -> None:
    part, other = _part(scene="x"), _part(scene="x")
    part["runs"] = [unfinished(r["scene"], r["recipe"], r["seed"]) for r in part["runs"]]
    assert {r["state"] for r in join_results([part, other], ["a", "b"])["runs"]} == {"done"}
    assert {r["state"] for r in join_results([other, part], ["a", "b"])["runs"]} == {"done"}
    with pytest.raises(
        PolarguideError, match=r"b: expected runs that no other record has, found x, 3dgs, seed 0"
    ):
        join_results([other, other], ["a", "b"])


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("settings", "steps"), 20, r"b \(settings.steps\): expected 10, as a has it, found 20"),
        (("provenance", "version"), "2", r"b \(provenance.version\)"),
        (("provenance", "sources"), "def", r"b \(provenance.sources\)"),
        (("scenes", 0, "digest"), "e" * 64, r"b \(scene x, digest\)"),
        (("scenes", 0, "test_views"), ["v1"], r"b \(scene x, test_views\)"),
        (("recipes", 0, "data"), {"steps": 1}, r"b \(recipe 3dgs\)"),
    ],
)
def test_what_does_not_belong_together_is_refused(path: tuple[Any, ...], value: object, said: str) -> None:
    part, other = _part(scene="x", seed=0), copy.deepcopy(_part(scene="x", seed=1))
    place: Any = other
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(PolarguideError, match=said):
        join_results([part, other], ["a", "b"])


def test_compilers_may_differ_but_not_the_commit() -> None:
    part, other = (_part(scene=scene) for scene in ("x", "y"))
    for number, record in enumerate((part, other)):
        record["provenance"] |= {"commit": "c" * 40, "sources": str(number)}
    assert join_results([part, other], ["a", "b"])["provenance"]["sources"] == "0; 1"
    other["provenance"]["commit"] = "d" * 40
    with pytest.raises(PolarguideError, match="commit"):
        join_results([part, other], ["a", "b"])


def test_files(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    write_results(tmp_path / "x" / "results.json", _part(scene="x"))
    write_results(tmp_path / "y.json", _part(scene="y"))
    joined = join_tables([tmp_path / "x", tmp_path / "y.json"], tmp_path / "all", against="3dgs")
    assert read_results(tmp_path / "all" / "results.json") == joined
    assert {"results.md", "results.csv", "results.tex", "differences.csv", "report.html"} <= {
        path.name for path in (tmp_path / "all").iterdir()
    }
    assert "mean" in (tmp_path / "all" / "results.md").read_text()
    assert "Pictures are in the reports of the parts." in (tmp_path / "all" / "report.html").read_text()


def test_a_part_is_not_written_over_by_the_whole(tmp_path: Path) -> None:
    for name, scene in zip("ab", "xy", strict=True):
        (tmp_path / name).mkdir()
        write_results(tmp_path / name / "results.json", _part(scene=scene))
    before = (tmp_path / "b/results.json").read_bytes()
    with pytest.raises(PolarguideError, match="would be written over"):
        join_tables([tmp_path / "a", tmp_path / "b"], tmp_path / "b")
    assert (tmp_path / "b/results.json").read_bytes() == before


def test_half_a_character_in_a_name_is_written_as_its_escape(tmp_path: Path) -> None:
    write_results(tmp_path / "results.json", results([run("s\ud800", "a", 0, psnr=20.0)]))
    join_tables([tmp_path / "results.json"], tmp_path / "new")
    assert "\\ud800" in (tmp_path / "new/results.md").read_text()
