"""What a finished training says of itself: it names what has burned, and is silent about what is right."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from faults import Fault
from heard import Heard
from safetensors.torch import load_file
from tiny import circling, make_scene
from torch import Tensor

import polarguide
from polarguide.capture import Scene, View, load_scene
from polarguide.capture.exposures import FOUR, PLAIN, Exposure
from polarguide.capture.variants import select_exposures
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.core.progress import SILENT
from polarguide.geometry.camera import Camera, look_at
from polarguide.methods import RECIPES
from polarguide.raster import choose_backend
from polarguide.runs.folder import RunLog
from polarguide.runs.health import (
    HEALTH,
    Health,
    Limits,
    PolarizationSupport,
    TrainingEvidence,
    examine,
    warnings_of,
)
from polarguide.runs.model import GaussianModel
from polarguide.runs.train import train_gaussians
from polarguide.shading.result import RenderResult
from polarguide.training.angles.polarizers import Polarizers
from polarguide.training.context import TrainingState
from polarguide.training.settings import TrainSettings
from polarguide_bench.report import recorded_health

STOKES = RECIPES["polarguide-stokes"]
BURNED = Path(__file__).parent / "burned"
LONG = 100_000
WHOLE = make_scene()


def around(scene: Scene, count: int = 12) -> Scene:
    """The scene with its pictures taken from more places: what a stand-in shows needs not be of one thing."""
    views = [
        dataclasses.replace(
            scene.views[k % len(scene.views)], name=f"v{k:02}", camera=circling(2 * math.pi * k / count)
        )
        for k in range(count)
    ]
    return dataclasses.replace(scene, views=tuple(views), test_names=())


def ball_depth(camera: Camera) -> Tensor:
    """Camera depth of a unit ball at the origin, 0 beside it."""
    rays = camera.world_rays(dtype=torch.float64)
    along = -(rays @ camera.center)
    under_root = along.square() - camera.center.square().sum() + 1
    distance = along - under_root.clamp(min=0).sqrt()
    return torch.where(under_root > 0, distance * camera.rays(dtype=torch.float64)[..., 2], 0.0).float()


class StandIn:
    """Renders what was measured in each view, but for its faults: a change of the result, by the view's name."""

    device = torch.device("cpu")

    def __init__(self, scene: Scene, **faults: Callable[[RenderResult], RenderResult]) -> None:
        self._views, self._faults = {id(view.camera): view for view in scene.views}, faults
        self.haze: dict[Camera, float] = {}

    def render(self, camera: Camera, **_: bool) -> RenderResult:
        view = self._views[id(camera)]
        final = view.photograph()
        alpha, radii = torch.ones(final.shape[:2]), torch.ones(10, dtype=torch.int32)
        layers = {"final": final, "base": final, "alpha": alpha, "depth": ball_depth(camera)}
        result = RenderResult(layers, training={"radii": radii})
        return self._faults.get(view.name, lambda same: same)(result)

    def stokes(self, result: RenderResult, camera: Camera) -> Tensor:
        return self._views[id(camera)].stokes()

    def alpha_in_front(self, camera: Camera, depth: Tensor) -> Tensor:
        return (depth > 0) * self.haze.get(camera, 0.0)


def evidence(scene: Scene, views: tuple[View, ...] | None = None) -> TrainingEvidence:
    return TrainingEvidence(
        views or scene.train_views, PolarizationSupport(len(scene.views), 0, 0), filters=True
    )


def examined(model: Any, scene: Scene, views: tuple[View, ...] | None = None) -> Health:
    return examine(model, evidence(scene, views), scene.points, LONG, SILENT)


def test_a_training_that_has_burned_is_named() -> None:
    """A real one: single shots of a cup on a table, 2,500 steps, by a version without a bound on the light."""
    scene = load_scene(BURNED)
    stored = load_file(BURNED / "burned.safetensors")  # in half precision, to be small
    tensors = {
        name: values.float() if values.is_floating_point() else values for name, values in stored.items()
    }
    state = TrainingState.from_tensors(tensors, STOKES)
    model = GaussianModel(state, STOKES.shading, choose_backend("cpu"))
    found = examined(model, scene)
    burned = {name for name, view in found.views.items() if view.burned > Limits().burned}
    assert {"v030", "v006", "v012"} <= burned < set(found.views)
    (said,) = [warning for warning in found.warnings if "burned" in warning]
    assert "v030 (" in said
    assert "add pictures" in said


def test_nothing_is_said_of_a_model_that_renders_what_was_measured() -> None:
    scene = around(WHOLE)
    found = examined(StandIn(scene), scene)
    assert found.warnings == ()
    assert len(found.views) == 12
    assert found.summary.startswith("health: 12 training views")


def bright(result: RenderResult) -> RenderResult:
    final = result.final.clone()
    final[3:5, 3:5] = 30.0
    return result.with_layers(final=final)


def dim(result: RenderResult) -> RenderResult:
    """As of an exposure that is wrong by two stops."""
    return result.with_layers(final=0.25 * result.final)


def dark(result: RenderResult) -> RenderResult:
    """As of an exposure that is longer by a third of a stop."""
    return result.with_layers(final=2 ** (-1 / 3) * result.final)


def warm(result: RenderResult) -> RenderResult:
    """As of another white balance."""
    return result.with_layers(final=result.final * torch.tensor([1.0, 1.0, 0.8]))


def noisy(result: RenderResult) -> RenderResult:
    """What every training leaves, so that a view without a fault is not perfect."""
    wave = 0.02 * torch.sin(torch.arange(result.final.shape[1], dtype=torch.float32))[None, :, None]
    return result.with_layers(final=result.final + wave)


def hollow(result: RenderResult) -> RenderResult:
    alpha = result.alpha.clone()
    alpha[5:12, 5:12] = 0.1
    return result.with_layers(alpha=alpha, final=result.final * alpha[..., None])


def broken(result: RenderResult) -> RenderResult:
    return result.with_layers(final=torch.full_like(result.final, torch.nan))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (bright, "burned"),
        (broken, "burned"),
        (dim, "stops: v04 +2.0"),
        (hollow, "holes"),
        (dark, "stops: v04 +0.3"),
        (warm, "stops: v04 +0.3"),
    ],
    ids=["bright", "not-finite", "dim", "hollow", "dark", "warm"],
)
def test_a_fault_of_one_view_is_one_warning_that_names_it(
    fault: Callable[[RenderResult], RenderResult], words: str
) -> None:
    scene = around(WHOLE)
    faults = {view.name: noisy for view in scene.views} | {"v04": lambda result: fault(noisy(result))}
    (said,) = examined(StandIn(scene, **faults), scene).warnings
    assert words in said
    assert "v04" in said
    assert not any(view.name in said for view in scene.views if view.name != "v04")


def test_haze_in_front_of_a_training_view_or_a_held_out_view_is_named() -> None:
    scene = around(WHOLE)
    model = StandIn(scene)
    held_out = circling(0.3)
    model.haze = {scene.views[7].camera: 0.05, held_out: 0.07, scene.views[2].camera: 0.019}
    (message,) = examined(model, scene).warnings
    assert "haze in front of v07 (5.0 % opacity)" in message
    seen = dataclasses.replace(evidence(scene), held_out={"h1": held_out})
    health = examine(model, seen, scene.points, LONG, SILENT)
    (message,) = health.warnings
    assert "haze in front of h1 (7.0 % opacity), v07:" in message
    assert health.haze["v02"] == pytest.approx(0.019)


def test_a_view_without_a_confirmed_surface_has_no_haze() -> None:
    scene = around(WHOLE)
    model = StandIn(scene)
    away = look_at((4.0, 0.0, 0.0), (8.0, 0.0, 0.0), (0.0, -1.0, 0.0))
    other = dataclasses.replace(scene.views[0].camera, rotation=away[0], translation=away[1])
    model.haze = {other: 0.5}
    seen = dataclasses.replace(evidence(scene), held_out={"h1": other})
    health = examine(model, seen, scene.points, LONG, SILENT)
    assert "h1" not in health.haze
    assert health.warnings == ()


def test_gaussians_that_no_view_sees_are_counted_once_all_views_were_looked_at() -> None:
    scene = around(WHOLE)

    def seen(result: RenderResult) -> RenderResult:
        return dataclasses.replace(
            result, training={"radii": result.training["radii"] * (torch.arange(10) < 7)}
        )

    model = StandIn(scene, **{view.name: seen for view in scene.views})
    found = examined(model, scene)
    assert found.unseen == pytest.approx(0.3)
    assert "30 % of the Gaussians" in found.warnings[0]
    few = examine(model, evidence(scene), scene.points, 300, SILENT)
    assert len(few.views) == 6
    assert few.unseen is None


@pytest.mark.parametrize("kind", ["four", "one"])
def test_a_wrong_angle_shows_behind_the_filter(kind: str) -> None:
    """The picture itself may be right: what is behind the filter is compared, of four pictures and of one."""
    scene = around(WHOLE)
    model = StandIn(scene, **{view.name: noisy for view in scene.views})
    views = scene.views if kind == "four" else select_exposures(scene, "one").views
    exposures = tuple(dataclasses.replace(e, angle=(e.angle + 90) % 180) for e in views[4].exposures)
    right = examined(model, scene, views)
    wrong = examined(model, scene, (*views[:4], views[4].with_exposures(exposures), *views[5:]))
    assert right.warnings == ()
    before, after = right.views["v04"].psnr, wrong.views["v04"].psnr
    assert after < before - 6


def test_views_are_spread_over_all_and_take_a_fiftieth_of_the_steps() -> None:
    scene = around(WHOLE, 100)
    counts = {steps: len(evidence(scene).chosen(steps)) for steps in (40, 500, 2_000, LONG)}
    assert counts == {40: 0, 500: 10, 2_000: 40, LONG: 64}
    names = [view.name for view in evidence(scene).chosen(500)]
    assert (names[0], names[-1]) == ("v00", "v99")


def test_half_and_double_the_limits_tell_the_same_of_a_burned_view() -> None:
    scene = around(WHOLE)
    found = examined(StandIn(scene, v04=bright), scene)
    for factor in (0.5, 2.0):
        limits = Limits(burned=factor * Limits().burned, far=factor * Limits().far)
        assert len(warnings_of(found.views, found.unseen, found.haze, limits)) == 1


def test_the_word_says_what_most_views_tell_and_what_is_in_doubt() -> None:
    one, plain = select_exposures(WHOLE, "one"), select_exposures(WHOLE, "none")
    truth = {view.name: view.stokes() for view in WHOLE.views}
    polarizers = Polarizers(one, STOKES, 40)
    polarizers.take(polarizers.fit(lambda view: truth[view.name])[None])

    def told(views: tuple[View, ...], **reads: bool) -> str:
        return PolarizationSupport.of(
            views, polarizers.judgments(), **({"measured": True, "fitted": True} | reads)
        ).text

    assert told(WHOLE.train_views) == "measured"
    assert told(one.train_views) == "fitted (0 of 5 pictures doubtful)"
    assert told(plain.train_views) == "none (layers and normals are a guess of the model)"
    assert told(one.train_views, fitted=False) == told(plain.train_views)
    assert told(WHOLE.train_views, measured=False) == told(plain.train_views)
    mixed = (*WHOLE.train_views[:1], *one.train_views[1:])
    assert told(mixed) == "fitted in 4 of 5 views (0 of 4 pictures doubtful), measured in 1"
    assert {view.exposures for view in WHOLE.train_views} == {FOUR}
    assert {view.exposures for view in plain.train_views} == {PLAIN}
    lost = tuple(view.with_exposures((Exposure(),)) for view in one.train_views)
    assert PolarizationSupport.of(lost, (), measured=True, fitted=True).word == "none"


@pytest.mark.parametrize("data", [b"{", b'{"views": 3}', b"\x00" * 9, None])
def test_a_damaged_record_is_a_warning_of_its_run(tmp_path: Path, data: bytes | None) -> None:
    assert recorded_health(tmp_path) == (None, ())
    if data is None:
        (tmp_path / HEALTH).symlink_to(tmp_path / "nowhere")
    else:
        (tmp_path / HEALTH).write_bytes(data)
    polarization, (warning,) = recorded_health(tmp_path)
    assert polarization is None
    assert HEALTH in warning


def test_a_training_writes_its_health_and_the_page_shows_it(demo_scene: Path, tmp_path: Path) -> None:
    heard = Heard()
    run = polarguide.train(
        demo_scene,
        tmp_path / "run",
        settings=TrainSettings(100),
        reading=SceneOptions(downscale=4),
        session=SessionOptions(threads=1),
        reporter=heard,
    )
    found = run.health
    assert len(found.views) == 2
    assert any(said.startswith("health: 2 training views") for said in heard.said)
    assert run.polarization == "measured"
    dataclasses.replace(found, warnings=("it has <burned>",)).save(run.folder)
    page = run.share().read_text(encoding="utf-8")
    assert "polarguide-stokes, 100 steps · polarization: measured</p>" in page
    assert "Warning: it has &lt;burned&gt;" in page
    sheet = run.write_pictures(views="v000", layers=["final"])
    assert b"tEXtPolarization\0measured" in sheet.read_bytes()
    (run.folder / HEALTH).write_text('{"polarization": {"measured": -1, "fitted": 0, "none": 0}}')
    Fault("health.json").raised_by(getattr, run, "health")
    (run.folder / HEALTH).unlink()
    assert run.polarization == "not recorded"


def test_held_out_scores_are_logged_and_change_no_training(
    tiny_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short training scores no held-out view. With more time it does, and ends with the same Gaussians."""
    states = []
    for share, logged in ((0.02, 0), (10.0, 2)):
        monkeypatch.setattr("polarguide.runs.health.TIME_SHARE", share)
        run = train_gaussians(tiny_scene, tmp_path / str(share), settings=TrainSettings(20))
        scores = [row["held_out"] for row in RunLog(run.folder).rows() if row["held_out"] is not None]
        assert len(scores) == logged
        states.append(run.model.state.gaussians.snapshot())
    assert all(torch.equal(states[0][name], tensor) for name, tensor in states[1].items())
