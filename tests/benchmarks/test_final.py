"""Lists of the final measurement, and the scene files of the held-back half."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

import polarguide
from polarguide.capture import load_scene
from polarguide.capture.layout import find_layout
from polarguide.core.errors import PolarguideError
from polarguide.results.evaluation.evaluate import code_digest
from polarguide_bench.options import BENCH
from polarguide_bench.results import (
    FORMAT,
    Provenance,
    RecipeRecord,
    SceneRecord,
    Settings,
    read_results,
)
from polarguide_synth.colmap import place_cameras
from polarguide_synth.settings import find_scene

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path += [str(BENCHMARKS / name) for name in ("accuracy", "final", "heldout")]
import measure  # noqa: E402
import render  # noqa: E402
from simulated_mosaics import FULL, linear_intensities, mosaic  # noqa: E402


@pytest.mark.parametrize("name", measure.PARTS)
def test_a_part_compares_known_recipes(name: str) -> None:
    part = measure.read_part(measure.HERE / f"{name}.json")
    assert part.against in (None, *part.recipes)
    assert min(part.recipes.values()) >= 1
    assert len(set(part.scenes)) == len(part.scenes)


def test_parts_contain_all_scenes() -> None:
    bench, heldout = (measure.read_part(measure.HERE / f"{name}.json") for name in ("bench", "heldout"))
    assert set(bench.scenes) == {*BENCH.development, *BENCH.held_back}
    assert (bench.steps, bench.refractive_index) == (BENCH.training.steps, BENCH.training.refractive_index)
    assert tuple(heldout.scenes) == render.SCENES
    files = {path.stem for path in render.HERE.glob("*.json") if path != render.CHECKSUMS}
    assert files == {*render.SCENES, *render.USED}
    assert not {*render.SCENES} & {*render.USED}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('{"about": "a", "scenes": ["a"], "steps": 9, "recipes": {"3dsg": 1}}', "3dsg"),
        ('{"about": "a", "scenes": ["a"], "steps": 9, "recipes": {"3dgs": "one"}}', "recipes"),
        ('{"about": "a", "scenes": ["a"], "steps": 9, "recipes": {"3dgs": 1}, "seed": 3}', "seed"),
        ('{"about": "a", "scenes": ["a"], "recipes": {"3dgs": 1}}', "steps"),
    ],
)
def test_a_wrong_part_is_refused(text: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "part.json").write_text(text)
    with pytest.raises(PolarguideError, match=fault):
        measure.read_part(tmp_path / "part.json")


def test_all_scenes_are_checked_before_the_first_training(tmp_path: Path) -> None:
    parts = [measure.read_part(measure.HERE / f"{name}.json") for name in ("four", "heldout")]
    for part in parts:
        for name in part.scenes:
            (tmp_path / part.folder / name).mkdir(parents=True)
    measure.check_scenes(parts, tmp_path)
    absent = tmp_path / parts[1].folder / parts[1].scenes[-1]
    absent.rmdir()
    with pytest.raises(PolarguideError, match=absent.name):
        measure.check_scenes(parts, tmp_path)


@pytest.mark.parametrize("name", render.SCENES + render.USED)
def test_a_held_back_scene_has_its_views(name: str) -> None:
    scene = find_scene(str(render.HERE / f"{name}.json"))
    assert scene.name == name
    assert (scene.camera.views, len(range(0, scene.camera.views, render.SYNTH.test_every))) == (48, 8)
    metals = {thing.name for thing in scene.things if thing.material.type == "metal"}
    assert bool(metals) == (name in ("workbench", "sideboard", *render.USED))
    assert scene.object_only == (name == "tortoise")


def test_all_cameras_are_inside_the_small_room() -> None:
    scene = find_scene(str(render.HERE / "bathroom.json"))
    cameras = place_cameras(scene.camera, render.SYNTH.width, render.SYNTH.height, render.SYNTH.seed)
    centers = np.stack([camera.center.numpy() for camera in cameras])
    assert np.abs(centers[:, :2]).max() < 1.5
    assert 0.7 < centers[:, 2].min() < centers[:, 2].max() < 2.3


@pytest.fixture
def rendering(demo_scene: Path, tmp_path: Path) -> Path:
    """The demo scene as ``synth`` would write it with a sensor."""
    folder = tmp_path / "rendering"
    for name in ("gt", "sparse"):
        shutil.copytree(demo_scene / name, folder / name)
    for name in ("split.json", "scene.json"):
        shutil.copyfile(demo_scene / name, folder / name)
    (folder / "calibration.json").write_text(
        json.dumps({"gains": dict.fromkeys(("0", "45", "90", "135"), 1.0)})
    )
    (folder / "raw").mkdir()
    layout = find_layout(demo_scene)
    for view in layout.names:
        light = mosaic(linear_intensities(layout, view, "linear"), electrons=0, rng=np.random.default_rng(0))
        values = np.rint(64 + light.astype(float) * (4095 - 64) / FULL).astype(np.uint16)
        assert cv2.imwrite(str(folder / "raw" / f"{view}.png"), values)
    return folder


def test_a_prepared_rendering_has_ground_truth(rendering: Path, demo_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    for _ in range(2):  # the second call changes nothing
        render.prepare_rendering(rendering, out)
    prepared = load_scene(out)
    demo = load_scene(demo_scene)
    assert prepared.test_names == demo.test_names
    assert prepared.objects == demo.objects
    for name in demo.test_names:
        view = prepared.view(name)
        assert view.ground_truth is not None
        valid = ~(view.invalid | view.saturated)
        difference = view.photograph() - demo.view(name).photograph()
        assert difference[valid].abs().median() < 0.01
        assert view.ground_truth.normal is not None


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Recipes that comparisons trained. They only write a record, in which ``3dgs-dr`` is missing the first time."""
    recipes: list[str] = []

    def compare(scenes: list[Path], names: list[str], out: Path, **options: Any) -> None:
        (scene,) = scenes
        runs = []
        for name in names:
            for seed in range(options["seeds_of"][name]):
                done = name != "3dgs-dr" or name in recipes
                run = {
                    "scene": scene.name,
                    "recipe": name,
                    "seed": seed,
                    "folder": "",
                    "error": None,
                    "views": {},
                }
                state = "done" if done else "missing"
                metrics = {"psnr": 30.0 + seed} if done else None
                runs.append({**run, "state": state, "metrics": metrics, "lpips_reason": None})
        recipes.extend(names)
        settings = Settings(options["settings"].steps, 1, 1, "srgb", None, 1, 1)
        record = {
            "format": FORMAT,
            "provenance": Provenance("0.2", None, code_digest(), "", ""),
            "settings": settings,
            "scenes": [SceneRecord(scene.name, "0", 3, ["v"])],
            "recipes": [RecipeRecord(name, "", {}) for name in names],
            "runs": runs,
        }
        out.mkdir(exist_ok=True)
        (out / "results.json").write_bytes(msgspec.json.encode(record))

    monkeypatch.setattr(polarguide, "compare", compare)
    return recipes


def test_a_recorded_recipe_is_not_trained_again(trained: list[str], tmp_path: Path) -> None:
    path = tmp_path / "record.json"

    def finished(out: str, recipes: dict[str, int]) -> list[tuple[str, int]]:
        part = measure.Part("", ["s"], 2, recipes, against="polgs")
        record = measure.measure(part, tmp_path / "s", tmp_path / out, path, jobs=2, threads=1)
        assert record == read_results(path)
        assert record.settings.against == ("polgs" if "polgs" in recipes else None)
        return [(run.recipe, run.seed) for run in record.runs if run.state == "done"]

    assert finished("1", {"3dgs": 1, "3dgs-dr": 1}) == [("3dgs", 0)]
    both = {"3dgs-dr": 1, "3dgs": 1}
    assert finished("2", both) == [("3dgs-dr", 0), ("3dgs", 0)]
    more = {"polgs": 1, "3dgs": 2, "3dgs-dr": 1}
    assert finished("3", more) == [("polgs", 0), ("3dgs", 0), ("3dgs", 1), ("3dgs-dr", 0)]
    assert finished("4", more) == [("polgs", 0), ("3dgs", 0), ("3dgs", 1), ("3dgs-dr", 0)]
    assert trained == ["3dgs", "3dgs-dr", "3dgs-dr", "polgs", "3dgs"]
    one = measure.read_finished(path, measure.Part("", ["s"], 2, {"polgs": 1}), threads=1)
    assert one is not None
    assert ([run.recipe for run in one.runs], [recipe.name for recipe in one.recipes]) == (
        ["polgs"],
        ["polgs"],
    )
    text = path.read_text()
    for old, new, fault in (
        (code_digest(), "0" * 16, "digest 0000000000000000"),
        ('"steps": 2', '"steps": 3', "settings.steps"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(PolarguideError, match=fault):
            finished("6", more)


def test_finished_seeds_stay_in_the_record(trained: list[str], tmp_path: Path) -> None:
    """``3dgs-dr`` is missing in the first comparison that trains it."""
    path = tmp_path / "record.json"

    def states(out: str, recipes: dict[str, int]) -> list[tuple[str, int, str]]:
        part = measure.Part("", ["s"], 2, recipes)
        record = measure.measure(part, tmp_path / "s", tmp_path / out, path, jobs=2, threads=1)
        return [(run.recipe, run.seed, run.state) for run in record.runs]

    states("1", {"3dgs-dr": 1})
    assert states("2", {"3dgs-dr": 1}) == [("3dgs-dr", 0, "done")]
    trained.clear()
    assert states("3", {"3dgs-dr": 2}) == [("3dgs-dr", 0, "done"), ("3dgs-dr", 1, "missing")]


def test_some_recipes_are_trained_first(trained: list[str], tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    part = measure.Part("", ["s"], 2, {"3dgs": 1, "polgs": 2})

    def seeds(*only: str) -> list[tuple[str, int]]:
        record = measure.measure(part, tmp_path / "s", tmp_path / "out", path, only=only)
        return [(run.recipe, run.seed) for run in record.runs]

    assert seeds("polgs") == [("polgs", 0), ("polgs", 1)]
    assert seeds("polgs") == [("polgs", 0), ("polgs", 1)]
    assert seeds() == [("3dgs", 0), ("polgs", 0), ("polgs", 1)]
    assert trained == ["polgs", "3dgs"]


def test_scenes_and_recipes_select_parts() -> None:
    parts = {
        "a": measure.Part("", ["cup", "car"], 2, {"3dgs": 1}),
        "b": measure.Part("", ["car"], 2, {"polgs": 1}),
    }
    assert measure.selected(parts, [], []) == parts
    assert measure.selected(parts, ["cup"], []) == {"a": measure.Part("", ["cup"], 2, {"3dgs": 1})}
    assert measure.selected(parts, [], ["polgs"]) == {"b": parts["b"]}
    assert measure.selected(parts, ["cup"], ["polgs"]) == {}
    with pytest.raises(PolarguideError, match="cap"):
        measure.selected(parts, ["cap"], [])
    with pytest.raises(PolarguideError, match="3dgss"):
        measure.selected(parts, [], ["3dgss"])


def test_an_earlier_comparison_is_not_a_record(
    trained: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    part = measure.Part("", ["s"], 2, {"3dgs": 1})
    path = tmp_path / "record.json"
    measure.measure(part, tmp_path / "s", tmp_path / "out", path, jobs=2, threads=1)
    path.unlink()

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(polarguide, "compare", stopped)
    with pytest.raises(KeyboardInterrupt):
        measure.measure(part, tmp_path / "s", tmp_path / "out", path, jobs=2, threads=1)
    assert not path.exists()
