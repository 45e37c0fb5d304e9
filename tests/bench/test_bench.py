"""The bench: its data, what is rendered and compared, what goes on and what is refused. Scenes of sixteen pixels."""

import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from faults import Fault
from heard import Heard

import polarguide
from polarguide.methods import recipe_named
from polarguide.training.settings import TrainSettings
from polarguide_bench import bench as benches
from polarguide_bench.bench import run_bench
from polarguide_bench.compare import locked
from polarguide_bench.join import join_tables
from polarguide_bench.options import BENCH, Bench, BenchOptions
from polarguide_synth import render as renderer
from polarguide_synth.folder import scene_digest
from polarguide_synth.settings import PRESETS, Overrides, SynthSettings, find_scene

RENDER = BenchOptions(render_only=True, jobs=1)


def scene_file(folder: Path, name: str, color: float = 0.2) -> str:
    """Write a scene file with a ball on a plane."""
    things = [
        {"name": "ground", "foreground": False, "shape": {"type": "plane", "size": [6, 6]}},
        {
            "name": "ball",
            "shape": {"type": "sphere", "radius": 0.6, "detail": 32},
            "position": [0, 0, 0.6],
            "material": {"color": [color, 0.3, 0.1]},
        },
    ]
    camera = {"rings": [{"radius": 3, "height": 1.2}], "target": [0, 0, 0.4], "fov": 45}
    data = {"name": name, "camera": camera, "environment": {"type": "uniform", "height": 4}, "exposure": 0.8}
    path = folder / f"{name}.json"
    path.write_text(json.dumps({**data, "depth": 2, "things": things}))
    return str(path)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    folder = tmp_path_factory.mktemp("files")
    return Bench(
        development=(scene_file(folder, "one"), scene_file(folder, "two")),
        held_back=(scene_file(folder, "secret"),),
        synth=SynthSettings(size="16x16", samples=1, points=60, test_every=2),
        views=3,
        rows={"3dgs": 1, "3dgs-dr": 2},
        training=TrainSettings(steps=7),
    )


@pytest.fixture(scope="module")
def rendered(bench: Bench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render the development half."""
    pytest.importorskip("mitsuba", reason="no Mitsuba -> pip install '.[synth]'")
    out = tmp_path_factory.mktemp("bench")
    assert run_bench(out, RENDER, bench=bench) is None
    return out


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
    """Replace ``compare`` and record its arguments."""
    calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def compare(*arguments: Any, **more: Any) -> str:
        calls.append((arguments, more))
        return "results"

    monkeypatch.setattr(benches, "compare", compare)
    return calls


def test_the_halves_share_nothing_and_have_all_presets() -> None:
    every = (*BENCH.development, *BENCH.held_back)
    assert len(set(every)) == len(every) == 11
    assert set(every) == set(PRESETS) - {"alloys", "frame", "glossy", "proof"}
    plan = renderer.Plan(Overrides(views=BENCH.views).apply(find_scene("kit")), BENCH.synth, Path("kit"))
    assert (len(plan.names), len(plan.tests)) == (56, 8)
    # ``polarguide synth NAME --size 192x144 --views 56 --test-every 7`` renders the same.
    assert BENCH.synth == SynthSettings(size="192x144", test_every=7)
    assert all(find_scene(name).name == name for name in every)


@pytest.mark.parametrize("name", BENCH.rows)
def test_rows_are_recipes(name: str) -> None:
    assert recipe_named(name).name == name
    assert BENCH.rows[name] == (3 if name.startswith("polarguide-stokes") else 1)


def test_scenes_are_rendered_once_and_compared(
    rendered: Path, bench: Bench, compared: list[tuple[tuple[Any, ...], dict[str, Any]]]
) -> None:
    stamps = {path: path.stat().st_mtime_ns for path in (rendered / "scenes").rglob("*.*") if path.suffix}
    heard = Heard()
    assert run_bench(rendered, BenchOptions(jobs=1), bench=bench, reporter=heard) == "results"
    ((scenes, recipes, out), options) = compared[0]
    assert scenes == [rendered / "scenes" / "one", rendered / "scenes" / "two"]
    assert recipes == ["3dgs", "3dgs-dr"]
    assert out == rendered / "development"
    assert options["settings"] == bench.training
    assert options["seeds_of"] == {"3dgs": 1, "3dgs-dr": 2}
    assert options["options"].seeds == 2
    assert options["command_line"] == f"polarguide bench --out {rendered}"
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    for scene in scenes:
        assert f"{scene}   SHA-256 of its checksums.txt: {scene_digest(scene)}" in heard.said
    assert not (rendered / "scenes" / "secret").exists()


def test_the_held_back_half_has_a_folder_of_its_own(
    bench: Bench, tmp_path: Path, compared: list[tuple[tuple[Any, ...], dict[str, Any]]]
) -> None:
    pytest.importorskip("mitsuba", reason="no Mitsuba -> pip install '.[synth]'")
    run_bench(tmp_path, BenchOptions(held_back=True, jobs=1), bench=bench)
    assert [path.name for path in (tmp_path / "scenes").glob("*/")] == ["secret"]
    ((scenes, _, out), options) = compared[0]
    assert (scenes, out) == ([tmp_path / "scenes" / "secret"], tmp_path / "held-back")
    assert options["command_line"].endswith("--held-back")


def test_a_part_of_a_half() -> None:
    assert BenchOptions(scenes=("water", "kit")).chosen(BENCH) == ("kit", "water")
    assert BenchOptions(scenes=("rough",), held_back=True).chosen(BENCH) == ("rough",)
    assert BenchOptions().chosen(BENCH) == BENCH.development
    for options, fault in (
        (BenchOptions(scenes=("rough",)), Fault("scenes", "figure", "rough", "--held-back")),
        (BenchOptions(scenes=("proof",)), Fault("scenes", "figure", "proof")),
        (BenchOptions(scenes=("kit",), held_back=True), Fault("scenes", "rough", "kit")),
    ):
        fault.raised_by(options.chosen, BENCH)


def test_a_rendering_that_was_stopped_goes_on(
    rendered: Path, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(job: renderer.Job, number: int) -> None:
        if (job.out.name, number) == ("two", 1):
            raise KeyboardInterrupt
        render(job, number)

    render = renderer.render_view
    monkeypatch.setattr(renderer, "render_view", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_bench(tmp_path, RENDER, bench=bench)
    first = tmp_path / "scenes" / "one" / "scene.json"
    stamp = first.stat().st_mtime_ns
    monkeypatch.setattr(renderer, "render_view", render)
    run_bench(tmp_path, RENDER, bench=bench)
    assert first.stat().st_mtime_ns == stamp
    for name in ("one", "two"):
        assert scene_digest(tmp_path / "scenes" / name) == scene_digest(rendered / "scenes" / name)


def changed_size(bench: Bench) -> Bench:
    return dataclasses.replace(bench, synth=dataclasses.replace(bench.synth, size="32x16"))


def changed_seed(bench: Bench) -> Bench:
    return dataclasses.replace(bench, synth=dataclasses.replace(bench.synth, seed=1))


def changed_preset(bench: Bench) -> Bench:
    (folder := Path(bench.development[1]).parent / "newer").mkdir(exist_ok=True)
    return dataclasses.replace(bench, development=(bench.development[0], scene_file(folder, "two", 0.4)))


@pytest.mark.parametrize(
    ("change", "where", "said"),
    [
        (changed_size, "one", "settings.width: 16 in place of 32"),
        (changed_seed, "one", "settings.seed: 0 in place of 1"),
        (changed_preset, "two", "material.color.0: 0.2 in place of 0.4"),
    ],
)
def test_scenes_of_another_version_are_refused(
    change: Callable[[Bench], Bench], where: str, said: str, rendered: Path, bench: Bench, compared: list[Any]
) -> None:
    place = str(rendered / "scenes" / where)
    Fault(place, "", said, f"Remove {place}").raised_by(
        run_bench, rendered, BenchOptions(jobs=1), bench=change(bench)
    )
    assert not compared


def test_a_changed_file_is_refused_before_anything_is_done(
    rendered: Path, bench: Bench, compared: list[Any]
) -> None:
    picture = rendered / "scenes" / "two" / "polar" / "v001_045.png"
    data = picture.read_bytes()
    picture.write_bytes(data + b"x")
    try:
        Fault("v001_045.png", "checksums.txt", "other contents").raised_by(
            run_bench, rendered, BenchOptions(jobs=1), bench=bench
        )
    finally:
        picture.write_bytes(data)
    assert not compared


def test_a_folder_of_something_else_is_refused(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "scenes" / "two").mkdir(parents=True)
    (tmp_path / "scenes" / "two" / "mine.txt").write_text("mine")
    Fault("two", "empty folder", "other files").raised_by(run_bench, tmp_path, RENDER, bench=bench)
    assert not (tmp_path / "scenes" / "one").exists()


def test_a_scene_is_no_place_for_the_bench_or_a_comparison(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "polar").mkdir()
    for place in (tmp_path, tmp_path / "polar" / "new"):
        refused = Fault(str(place), "an output folder", "scene")
        refused.raised_by(run_bench, place, RENDER, bench=bench)
        refused.raised_by(polarguide.compare, [tmp_path], ["3dgs"], place)
    Fault("results.json").raised_by(join_tables, [tmp_path], tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == ["polar"]


def test_without_mitsuba_nothing_is_begun(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    Fault("synth", "mitsuba", "", "install").raised_by(run_bench, tmp_path / "out", RENDER, bench=bench)
    assert not (tmp_path / "out").exists()


def test_rendered_scenes_do_not_need_mitsuba(
    rendered: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, compared: list[Any]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    run_bench(rendered, BenchOptions(jobs=1), bench=bench)
    assert len(compared) == 1


def test_that_meshes_will_have_no_score_is_said_at_once(
    rendered: Path,
    bench: Bench,
    compared: list[tuple[tuple[Any, ...], dict[str, Any]]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for lacking, times in ((None, 0), ("skimage is not installed", 1)):
        monkeypatch.setattr(benches, "missing_package", lambda lacking=lacking: lacking)
        heard = Heard()
        run_bench(rendered, BenchOptions(jobs=1), bench=bench, reporter=heard)
        assert heard.said.count("mesh scores will have no value: skimage is not installed") == times
    assert len(compared) == 2


def test_an_unknown_row_is_refused_before_rendering(bench: Bench, tmp_path: Path) -> None:
    unknown = dataclasses.replace(bench, rows={"magic": 1})
    Fault("recipe", "3dgs", "magic").raised_by(run_bench, tmp_path / "out", BenchOptions(), bench=unknown)
    assert not (tmp_path / "out").exists()


def test_two_at_a_time_are_refused(rendered: Path, bench: Bench) -> None:
    with locked(rendered / "scenes"):
        Fault("scenes", "", "at work").raised_by(run_bench, rendered, RENDER, bench=bench)
