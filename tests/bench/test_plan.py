"""Which runs a comparison has and when one is found again; what it refuses."""

import dataclasses
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from faults import Fault
from heard import Heard

import polarguide
from polarguide.core.options import SceneOptions
from polarguide.methods import RECIPES, recipe_named
from polarguide.results.evaluation.evaluate import code_digest, evaluate
from polarguide.runs.opened import OpenedRun
from polarguide.training.settings import TrainSettings
from polarguide_bench import plan as plans
from polarguide_bench.compare import ablated, collect, compare
from polarguide_bench.options import CompareOptions
from polarguide_bench.plan import Comparison, PlannedRun, SceneEntry, plan_runs, run_key, scene_entries
from polarguide_bench.recipes import ABLATIONS
from polarguide_bench.results import read_results

SETTINGS = TrainSettings(40, 0)
ENTRY = SceneEntry(Path("cup"), "cup", "digest", 9, ("v0",))


def asked(**changes: Any) -> Comparison:
    """Return a comparison of two recipes."""
    names = [field.name for field in dataclasses.fields(CompareOptions)]
    options = {name: changes.pop(name) for name in names if name in changes}
    values: dict[str, Any] = {
        "scenes": (Path("cup"),),
        "recipes": (recipe_named("3dgs"), recipe_named("polarguide:without-normals")),
        "settings": SETTINGS,
        "options": CompareOptions(**{"seeds": 2, "device": "cpu", "jobs": 1, **options}),
        "out": Path("out"),
    }
    return Comparison(**{**values, **changes})


def folders(**changes: Any) -> list[Path]:
    return [planned.folder for planned in plan_runs(asked(**changes), [ENTRY])]


def test_every_scene_recipe_and_seed_has_a_folder_of_its_own() -> None:
    found = folders()
    assert len(set(found)) == 4
    assert found[1].parts[:4] == ("out", "runs", "cup", "polarguide__without-normals")
    assert [folder.name[:2] for folder in found] == ["0-", "0-", "1-", "1-"]


def test_the_same_question_has_the_same_folders() -> None:
    assert folders() == folders()
    # Options without an effect on results do not change the folders.
    assert folders(jobs=4, threads=2, speed=True, report_views=0, scenes=(Path("moved/cup"),)) == folders()


@pytest.mark.parametrize(
    "changes",
    [
        {"settings": TrainSettings(41, 0)},
        {"settings": TrainSettings(40, 0, 1.33)},
        {"downscale": 2},
        {"transfer": "srgb"},
    ],
)
def test_another_question_has_other_folders(changes: dict[str, Any]) -> None:
    assert not set(folders(**changes)) & set(folders())


def test_seeds_count_up_from_that_of_the_settings() -> None:
    runs = plan_runs(asked(settings=TrainSettings(40, 3)), [ENTRY])
    assert [run.settings.seed for run in runs] == [3, 3, 4, 4]


def test_each_scene_has_its_refractive_index_where_none_is_asked_for() -> None:
    water = replace(ENTRY, name="water", digest="another", refractive_index=1.33)

    def found(index: float | None) -> list[float | None]:
        settings = TrainSettings(40, refractive_index=index)
        return [run.settings.refractive_index for run in plan_runs(asked(settings=settings), [ENTRY, water])]

    assert set(found(None)[: len(found(None)) // 2]) == {1.5}
    assert set(found(None)[len(found(None)) // 2 :]) == {1.33}
    assert set(found(1.6)) == {1.6}


def test_a_recipe_may_have_seeds_of_its_own() -> None:
    runs = plan_runs(asked(settings=TrainSettings(40, 3), seeds_of={"3dgs": 3}), [ENTRY])
    found = [(run.row.recipe.name, run.settings.seed) for run in runs]
    other = "polarguide:without-normals"
    assert found == [("3dgs", 3), (other, 3), ("3dgs", 4), (other, 4), ("3dgs", 5)]
    assert folders(seeds_of={"3dgs": 1}) == [folders()[k] for k in (0, 1, 3)]


@pytest.mark.parametrize(
    ("recipes", "words", "rows"),
    [
        (["polarguide-stokes"], ("four", "one", "none"), ["four", "one", "none"]),
        (
            ["3dgs", "polarguide-stokes"],
            ("one", "none"),
            ["3dgs one", "3dgs none", "polarguide-stokes one", "polarguide-stokes none"],
        ),
    ],
)
def test_exposures_have_rows_and_folders_by_their_words(
    recipes: list[str], words: tuple[str, ...], rows: list[str]
) -> None:
    question = asked(recipes=tuple(map(recipe_named, recipes)), exposures=words, seeds=1)
    runs = plan_runs(question, [ENTRY])
    assert [run.row.name for run in runs] == rows
    assert [run.folder.parent.name for run in runs] == [row.replace(" ", "-") for row in rows]
    assert [run.settings.exposures for run in runs] == [row.split()[-1] for row in rows]
    assert runs[-1].row.recipe.name == "polarguide-stokes:unpolarized"
    assert len({run.folder.name for run in runs}) == len(runs)
    assert question.command.endswith(f"--exposures {' '.join(words)}")


@pytest.mark.parametrize("words", [("one", "one"), ("five",)])
def test_words_are_checked(words: tuple[str, ...]) -> None:
    Fault("exposures").raised_by(CompareOptions, exposures=words)


def test_another_scene_recipe_value_or_program_has_another_key(monkeypatch: pytest.MonkeyPatch) -> None:
    def key(scene: str = "s", recipe: dict[str, Any] | None = None, code: str = "c", seed: int = 0) -> str:
        data = RECIPES["3dgs"].data() if recipe is None else recipe
        return run_key(scene, data, TrainSettings(40, seed), SceneOptions(), code=code)

    changed = dataclasses.replace(RECIPES["3dgs"], ssim_weight=0.3).data()
    keys = [key(), key(scene="t"), key(recipe=changed), key(code="d"), key(seed=1)]
    assert len(set(keys)) == len(keys)
    assert key() == key()
    before = folders()
    monkeypatch.setattr(plans, "code_digest", lambda training: "other")
    assert not set(before) & set(folders())


def test_the_command_in_the_record_asks_for_the_same() -> None:
    command = asked(scenes=(Path("my cup"),)).command
    assert command.startswith(
        "polarguide compare 'my cup' --recipes 3dgs polarguide:without-normals --steps 40"
    )
    assert "--exposures" not in command
    assert asked(command_line="polarguide bench --out x").command == "polarguide bench --out x"


@pytest.fixture
def planned(trained: Path, demo_scene: Path, tmp_path: Path) -> PlannedRun:
    """Copy the short training of the demo scene to a run of a comparison."""
    question = asked(
        scenes=(demo_scene,), recipes=(recipe_named("polarguide-stokes"),), seeds=1, downscale=4, out=tmp_path
    )
    (only,) = plan_runs(question, scene_entries(question))
    shutil.copytree(trained, only.folder)
    return only


def test_truth_that_some_views_lack_is_said_before_anything_is_trained(
    demo_scene: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "partial"
    shutil.copytree(demo_scene, scene)
    told = json.loads((scene / "split.json").read_text())["test"]
    (scene / "gt" / f"{told[0]}.npz").unlink()
    question = asked(
        scenes=(scene,),
        recipes=(recipe_named("3dgs"),),
        settings=TrainSettings(40, refractive_index=1.5),
        seeds=1,
        downscale=4,
        out=tmp_path / "out",
    )
    reporter = Heard()
    entries = scene_entries(question, reporter)
    (said,) = [text for text in reporter.said if text.startswith("partial: The ground truth")]
    assert f"of {len(told) - 1} of {len(told)} test views" in said
    record = collect(question, entries, plan_runs(question, entries), {})
    assert record.record.scenes[0].warnings == [text.removeprefix("partial: ") for text in reporter.said]


def test_of_a_whole_scene_a_record_has_no_warnings(demo_scene: Path, tmp_path: Path) -> None:
    question = asked(scenes=(demo_scene,), downscale=4, out=tmp_path)
    entries = scene_entries(question)
    assert not collect(question, entries, plan_runs(question, entries), {}).record.scenes[0].warnings


def test_how_far_a_run_is(planned: PlannedRun, tmp_path: Path) -> None:
    metrics, other = planned.folder / "metrics.json", dataclasses.replace(planned, folder=Path("none"))
    assert (planned.state(), other.state()) == ("trained", "new")
    evaluate(OpenedRun.open(planned.folder))
    assert planned.state() == "done"
    record = json.loads(metrics.read_text())
    assert (record["fps"], record["fps_layers"]) == (None, None)
    assert record["provenance"]["sources"] == code_digest()
    for change in (
        {"steps": 39},
        {"psnr": "high"},
        {"provenance": record["provenance"] | {"sources": "old"}},
    ):
        metrics.write_text(json.dumps(record | change))
        assert planned.state() == "trained", change
    metrics.write_text('{"psnr": 3')
    assert planned.state() == "trained"
    shutil.copytree(planned.scene.path, tmp_path / "demo")
    moved = dataclasses.replace(planned, scene=dataclasses.replace(planned.scene, path=tmp_path / "demo"))
    assert moved.state() == "begun"
    (planned.folder / "point_cloud.ply").unlink()
    assert planned.state() == "begun"
    metrics.write_text(json.dumps(record))
    configuration = planned.folder / "run.json"
    configuration.write_text(configuration.read_text().replace('"downscale": 4', '"downscale": 2'))
    assert planned.state() == "begun", "a run of something else is not taken for this one"


def test_ablations_by_name() -> None:
    every = ablated("polarguide")
    assert every == ("polarguide", *(recipe.name for recipe in ABLATIONS["polarguide"]))
    some = ablated("polarguide", ("without-mask", "polarguide:only-normals"))
    assert some == ("polarguide", "polarguide:only-normals", "polarguide:without-mask")
    Fault("only", "only-normals", "without-luck").raised_by(ablated, "polarguide", ("without-luck",))
    Fault("base", "polarguide", "ref-gs").raised_by(ablated, "ref-gs")


SHORT = TrainSettings(steps=20)
OPTIONS = CompareOptions(downscale=8, jobs=1, report_views=1)


@pytest.mark.slow
def test_a_comparison_and_an_ablation_share_runs(
    demo_scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    messages = Heard()
    results = polarguide.compare(
        [demo_scene],
        [recipe_named("3dgs-dr")],
        tmp_path,
        settings=SHORT,
        options=OPTIONS,
        reporter=messages,
    )
    index, count, end = messages.said
    assert "refractive index 1.5" in index
    assert "1, of them finished before: 0" in count
    assert "demo, 3dgs-dr, seed 0" in end
    assert read_results(tmp_path / "results.json") == results.record
    assert results.runs["state"].tolist() == ["done"]
    assert results.scores["psnr"].tolist() == results.runs["psnr"].tolist()
    assert (tmp_path / "report.html").exists()

    # The run of an ablation cannot begin: its folder holds something else.
    only = "3dgs-dr:consistent"
    question = Comparison((demo_scene,), (recipe_named(only),), SHORT, OPTIONS, tmp_path)
    (planned,) = plan_runs(question, scene_entries(question))
    planned.folder.mkdir(parents=True)
    (planned.folder / "run.json").write_text("[]")
    results = polarguide.ablate(
        [demo_scene], "3dgs-dr", tmp_path, only=["consistent"], settings=SHORT, options=OPTIONS
    )
    runs = results.runs.set_index("recipe")
    assert runs["state"].to_dict() == {"3dgs-dr": "done", only: "failed"}
    assert "run.json" in runs.loc[only, "error"]
    assert results.record.settings.against == "3dgs-dr"
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("scenes", "recipes", "more", "fault"),
    [
        (["demo"], [replace(recipe_named("3dgs"), ssim_weight=0.3)], {}, Fault("recipe 3dgs", "no other")),
        (
            ["demo"],
            ["3dgs"],
            {"options": CompareOptions(against="3dgs-dr")},
            Fault("against", "3dgs", "3dgs-dr"),
        ),
        (["demo"], ["magic"], {}, Fault("recipe", "3dgs", "magic")),
        ([], ["3dgs"], {}, Fault("compare", "a scene", "none")),
        (["demo"], [], {}, Fault("compare", "a recipe", "none")),
        (["demo"], ["3dgs"], {"seeds_of": {"3dgs-dr": 2}}, Fault("seeds_of", "3dgs", "3dgs-dr")),
        (["demo"], ["3dgs"], {"seeds_of": {"3dgs": 0}}, Fault("seeds_of", "1 or more", "0")),
    ],
)
def test_what_cannot_be_compared_is_refused_before_there_is_a_folder(
    demo_scene: Path,
    tmp_path: Path,
    scenes: list[str],
    recipes: list[Any],
    more: dict[str, Any],
    fault: Fault,
) -> None:
    """Also a recipe that other processes do not know by its name."""
    paths = [demo_scene for _ in scenes]
    fault.raised_by(compare, paths, recipes, tmp_path / "out", **more)
    assert not (tmp_path / "out").exists()
