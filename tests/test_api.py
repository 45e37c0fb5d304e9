"""``import polarguide``: training, opening, rendering and scoring from Python, in silence."""

import contextlib
import json
import runpy
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from camera_files import write_mosaics
from faults import Fault
from reduced_demo import VIEWS
from safetensors.torch import load_file
from trainings import Reports, different

import polarguide
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.core.progress import Advance
from polarguide.results.evaluation.evaluate import validate_metrics
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION, PLY
from polarguide.shading.result import LAYERS, POLARIZED
from polarguide.training.loop import TrainingLoop

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
ONE_THREAD = SessionOptions(threads=1)
SMALL = SceneOptions(downscale=8)


@pytest.fixture
def copy(trained: Path, tmp_path: Path) -> Path:
    """A copy of the training that may be changed."""
    return Path(shutil.copytree(trained, tmp_path / "copy"))


def edit(folder: Path, **changes: object) -> None:
    path = folder / CONFIGURATION
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


class Listener(polarguide.Reporter):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.tracked: dict[str, tuple[int, str]] = {}

    def say(self, text: str) -> None:
        self.said.append(text)

    def warn(self, text: str) -> None:
        self.said.append(f"warning: {text}")

    @contextlib.contextmanager
    def track(self, label: str, total: int | None) -> Iterator[Advance]:
        def advance(
            done: int, *, total: int | None = None, note: str = "", seconds: float | None = None
        ) -> None:
            self.tracked[label] = (done, note)

        yield advance


def test_every_public_name_is_there() -> None:
    assert dir(polarguide) == sorted(polarguide.__all__)
    assert {"polarguide-stokes", "polarguide:only-normals"} <= set(polarguide.recipes())
    for name in polarguide.__all__:
        assert getattr(polarguide, name) is not None
    for package in ("polarguide", "polarguide_shots", "polarguide_bench", "polarguide_synth"):
        assert (Path(polarguide.__file__).parents[1] / package / "py.typed").exists()
    with pytest.raises(AttributeError, match="nothing"):
        _ = polarguide.nothing


def test_the_demo_scene_is_a_folder_like_any_other() -> None:
    scene = polarguide.load_scene(polarguide.demo_scene(), views=["v000"])
    assert scene.root == polarguide.demo_scene()
    assert scene.view("v000").camera.width == 128


def test_a_run_represents_itself_in_two_lines_and_html_even_where_parts_are_missing(copy: Path) -> None:
    run = polarguide.open_run(copy)
    first, second = repr(run).splitlines()
    assert f"{copy}: polarguide-stokes, 40 steps" in first
    assert second == f" polarization: {run.polarization}>"
    page = run._repr_html_()
    assert page.count("<img") == 3
    assert "metrics.json" in page  # it has not been scored
    run.evaluate(speed=False)
    assert "PSNR" in run._repr_html_()
    (copy / "health.json").write_text("{}")
    assert "not known" in repr(run)
    edit(copy, scene=str(copy / "elsewhere"))
    assert "elsewhere" in polarguide.open_run(copy)._repr_html_()


def test_runs_open_and_render_in_inference_mode(trained: Path) -> None:
    run = polarguide.open_run(trained)
    expected = run.render("v000", run.layers)
    with torch.inference_mode():
        within = polarguide.open_run(trained)
        rendered = [run.render("v000", run.layers), within.render("v000", run.layers)]
    for layers in (*rendered, within.render("v000", run.layers)):
        assert all(torch.equal(layers[name], expected[name]) for name in run.layers)


def test_training_is_silent_and_tells_the_reporter(
    demo_scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    listener = Listener()
    steps: list[int] = []

    def should_stop() -> bool:
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
        steps.append(len(steps))
        return False

    run = polarguide.train(
        demo_scene,
        tmp_path / "run",
        recipe="3dgs",
        settings=polarguide.TrainSettings(12),
        reading=SMALL,
        session=ONE_THREAD,
        reporter=listener,
        should_stop=should_stop,
    )
    assert len(steps) == 12
    assert listener.tracked["training"][0] == 12
    assert "PSNR" in listener.tracked["training"][1]
    assert listener.tracked["reading demo"][0] == len(VIEWS)
    record = run.evaluate()
    validate_metrics(record)
    assert record == run.metrics() == polarguide.open_run(tmp_path / "run").metrics()
    assert record["fps"] is None
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_what_training_returns_is_what_it_wrote(demo_scene: Path, tmp_path: Path) -> None:
    scene = polarguide.load_scene(demo_scene, downscale=8)
    settings = polarguide.TrainSettings(6, seed=3)
    run = polarguide.train(
        scene, tmp_path / "run", recipe="polarguide", settings=settings, session=ONE_THREAD
    )
    assert isinstance(run.recipe, polarguide.Recipe)
    assert run.scene is scene
    opened = polarguide.open_run(tmp_path / "run", recipe=run.recipe, scene=scene)
    assert (opened.steps, opened.recipe.name) == (6, "polarguide")
    for name, values in run.render("v000", layers=run.layers).items():
        assert torch.equal(values, opened.render("v000", layers=[name])[name]), name
    assert "reflection" in run.layers
    assert {*run.layers} <= {*LAYERS, *POLARIZED}


def test_a_keyboard_interrupt_saves_a_whole_state_and_goes_on_to_the_same_bits(
    trained: Path, demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the middle of a rendering, where nothing has changed yet; and in an optimizer's step, where it has."""
    settings, reading = polarguide.TrainSettings(40), SceneOptions(downscale=4)
    session = SessionOptions(threads=1, checkpoint_every=10)

    def train(*, resume: bool) -> None:
        polarguide.train(
            demo_scene, tmp_path / "run", settings=settings, reading=reading, session=session, resume=resume
        )

    def interrupted_in(name: str, at: int) -> None:
        inner = getattr(TrainingLoop, name)

        def stopped(self: TrainingLoop, *arguments: object, **more: object) -> object:
            if self.state.step == at:
                raise KeyboardInterrupt
            return inner(self, *arguments, **more)

        resume = (tmp_path / "run" / CONFIGURATION).exists()
        with monkeypatch.context() as patch:
            patch.setattr(TrainingLoop, name, stopped)
            with pytest.raises(KeyboardInterrupt):
                train(resume=resume)

    interrupted_in("backpropagate", 17)
    assert int(load_file(tmp_path / "run" / CHECKPOINT)["scalars"][0]) == 17
    assert not (tmp_path / "run" / PLY).exists()
    interrupted_in("update_parameters", 25)
    assert int(load_file(tmp_path / "run" / CHECKPOINT)["scalars"][0]) == 20
    train(resume=True)
    whole = load_file(trained / CHECKPOINT)
    assert not set(different(tmp_path / "run" / CHECKPOINT, whole)) & whole.keys()


def test_stopping_when_asked(demo_scene: Path, tmp_path: Path) -> None:
    kept = Reports()
    with pytest.raises(KeyboardInterrupt, match="stopped after step 4"):
        polarguide.train(
            demo_scene,
            tmp_path / "run",
            recipe="3dgs",
            settings=polarguide.TrainSettings(12),
            reading=SMALL,
            session=ONE_THREAD,
            should_stop=lambda: len(kept.reports) == 4,
            callbacks=[kept],
        )
    assert polarguide.open_run(tmp_path / "run").steps == 4


def test_a_run_renders_by_name_and_by_camera(trained: Path) -> None:
    run = polarguide.open_run(trained)
    layers = run.render("v000", layers=["final", "normal", "alpha"])
    assert set(layers) == {"final", "normal", "alpha"}
    assert layers["final"].shape == (*layers["alpha"].shape, 3)
    torch.testing.assert_close(layers["final"], run.render(run.cameras["v000"])["final"])
    assert len(run.gaussians["means"]) == len(run.gaussians["opacity_logits"]) == run.model.gaussians
    assert run.light is not None
    assert "Gaussians" in repr(run)
    Fault(found="color").raised_by(run.render, "v000", layers=["color"])
    Fault(found="nowhere").raised_by(run.render, "nowhere")
    Fault("metrics.json").raised_by(run.metrics)


def test_a_run_opens_without_its_scene(copy: Path, demo_scene: Path, tmp_path: Path) -> None:
    edit(copy, scene=str(tmp_path / "gone"))
    run = polarguide.open_run(copy)
    camera = polarguide.open_run(copy, scene=demo_scene).cameras["v000"]
    assert run.render(camera)["final"].shape == (camera.height, camera.width, 3)
    Fault("gone").raised_by(getattr, run, "cameras")


def test_a_changed_scene_is_warned_of_when_it_is_read(copy: Path, demo_scene: Path) -> None:
    edit(copy, scene_digest="another")
    run = polarguide.open_run(copy, scene=demo_scene)
    with pytest.warns(polarguide.PolarguideWarning, match="has changed since"):
        _ = run.scene
    _ = run.scene  # once


def test_a_changed_recipe_is_warned_of_on_opening(copy: Path) -> None:
    data = json.loads((copy / CONFIGURATION).read_text())["recipe_data"]
    other = json.loads(json.dumps(data))
    other["shading"]["blend"] = "another"
    edit(copy, recipe_data=other)
    with pytest.warns(polarguide.PolarguideWarning, match="recipe"):
        polarguide.open_run(copy)


def test_values_that_do_not_draw_pictures_open_in_silence(copy: Path) -> None:
    data = json.loads((copy / CONFIGURATION).read_text())["recipe_data"]
    edit(copy, recipe_data=data | {"ssim_weight": 0.875})
    assert polarguide.open_run(copy).steps == 40


def test_a_run_whose_version_recorded_fewer_constants_opens_in_silence(copy: Path) -> None:
    data = json.loads((copy / CONFIGURATION).read_text())["recipe_data"]
    del (
        data["metal_rules"],
        data["metal_views"],
        data["priors"]["flat_rules"],
        data["stages"][1]["weights"]["coverage"],
    )
    edit(copy, recipe_data=data)
    assert "Gaussians" in repr(polarguide.open_run(copy))


@pytest.mark.parametrize("place", ["", "settings"])
def test_a_run_with_a_setting_that_is_not_known_is_refused(copy: Path, place: str) -> None:
    record = json.loads((copy / CONFIGURATION).read_text())
    edit(copy, **({place: record[place] | {"twice": True}} if place else {"twice": True}))
    Fault(f"({place}.twice)" if place else "(twice)", "only", "twice").raised_by(polarguide.open_run, copy)


@pytest.mark.parametrize("version", ["0.1.0", "0.1.7", "9.0.0"])
def test_a_run_of_another_version_is_refused_with_what_to_do(copy: Path, version: str) -> None:
    edit(copy, version=version, unknown_then=3)
    Fault("", "", f"a run of version {version}", "new folder").raised_by(polarguide.open_run, copy)


def test_a_film_and_pictures_from_python(trained: Path, tmp_path: Path) -> None:
    run = polarguide.open_run(trained)
    run.relight(degrees=45)
    sheet = run.write_pictures(tmp_path / "pictures", views="v000", layers=["final", "normal"])
    assert {path.name for path in sheet.parent.iterdir()} == {"v000_final.png", "v000_normal.png", sheet.name}
    run.write_film(tmp_path / "film", frames=2, layers=["final"])
    assert len(list((tmp_path / "film").iterdir())) == 2


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(
    example: Path, trained: Path, demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    trains = "polarguide.train(" in example.read_text()
    given = [str(demo_scene), str(tmp_path / "out"), "8"] if trains else [str(trained), str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", [str(example), *given])
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out


def test_measuring_is_silent_and_gives_the_outcome(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "parts").mkdir()
    write_mosaics(tmp_path / "parts", 2, color=False, bits=12)
    heard: list[str] = []
    options = polarguide.MeasureOptions(roi=("left=0,0,20,48",))
    reading = polarguide.ShotOptions(sensor="IMX250MZR", bits=12)
    outcome = polarguide.measure(
        [tmp_path / "parts"],
        tmp_path / "line",
        options,
        reading,
        heard=lambda entry: heard.append(entry.shot),
    )
    assert (outcome.counts, outcome.exit_status, heard) == ({"measured": 2}, 0, ["v000", "v001"])
    watching = polarguide.WatchOptions(settle=0.05, idle=0.1)
    again = polarguide.watch_folder(tmp_path / "parts", tmp_path / "line", options, reading, watching)
    assert again.counts == {}
    assert capfd.readouterr() == ("", "")
