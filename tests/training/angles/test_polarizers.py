"""Unknown angles in training: found, believed, doubted, and the same after a resume."""

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from heard import Heard
from tiny import make_scene
from torch import Tensor
from trainings import context_of, different, fits_of, run

from polarguide.capture import Scene, View
from polarguide.capture.angle_evidence import mean_angle
from polarguide.capture.exposures import FOUR, Exposure, read_table
from polarguide.capture.variants import select_exposures
from polarguide.methods import RECIPES, recipe_named
from polarguide.runs.health import report_polarizers
from polarguide.training.angles.polarizers import Polarizers, gaussian_training
from polarguide.training.checkpoint_checks import refuse_foreign
from polarguide.training.context import TrainingState
from polarguide.training.loop import TrainingLoop
from polarguide.training.recipe import AngleRules, Recipe
from polarguide.training.settings import TrainSettings

STOKES = RECIPES["polarguide-stokes"]
WHOLE = make_scene()
TRUTH = {view.name: view.stokes() for view in WHOLE.views}
STEPS = 40
RULES = AngleRules()


def predicted(view: View) -> Tensor:
    """A model that has learned everything."""
    return TRUTH[view.name]


def unknown(search: int = 0) -> tuple[Scene, Polarizers]:
    """Pictures whose angles are to be found."""
    scene = select_exposures(WHOLE, "unknown")
    return scene, Polarizers(scene, STOKES, STEPS, search=search)


def reported(folder: Path, scene: Scene, polarizers: Polarizers) -> list[str]:
    """The sentences of the report."""
    heard = Heard()
    report_polarizers(folder, scene, polarizers, heard)
    return heard.said


def judged(scene: Scene) -> Polarizers:
    polarizers = Polarizers(scene, STOKES, STEPS)
    polarizers.take(polarizers.fit(predicted)[None])
    return polarizers


def with_exposures(scene: Scene, **said: Exposure) -> Scene:
    """The scene with other words about single pictures."""
    views = [
        dataclasses.replace(view, exposures=(said[view.name],)) if view.name in said else view
        for view in scene.views
    ]
    return dataclasses.replace(scene, views=tuple(views))


def test_unknown_angles_are_found_and_believed() -> None:
    (scene, polarizers), true = unknown(), select_exposures(WHOLE, "one")
    assert polarizers.judgments() == []
    assert next(step for step in range(STEPS) if polarizers.due(step)) == STEPS // 2
    changed = polarizers.take(polarizers.fit(predicted)[None])
    assert changed == {view.name for view in scene.train_views}
    for view, known in zip(scene.train_views, true.train_views, strict=True):
        believed, said = polarizers.believed(view).exposures[0], known.exposures[0]
        assert (believed.angle - said.angle + 90) % 180 - 90 == pytest.approx(0, abs=0.1)
        assert torch.equal(polarizers.believed(view).codes, view.codes)
    assert polarizers.take(polarizers.fit(predicted)[None]) == set()


def test_four_pictures_of_a_sensor_are_left_alone() -> None:
    polarizers = Polarizers(WHOLE, STOKES, STEPS)
    assert not any(polarizers.due(step) for step in range(STEPS))
    view = WHOLE.train_views[0]
    assert polarizers.believed(view) is view


def test_recipes_without_the_term_ignore_angles() -> None:
    scene = select_exposures(WHOLE, "unknown")
    for name in ("3dgs", "polarguide", "polarguide-stokes:unpolarized"):
        polarizers = Polarizers(scene, recipe_named(name), STEPS)
        assert polarizers.ignored
        assert not any(polarizers.due(step) for step in range(STEPS))
    assert not Polarizers(scene, STOKES, STEPS).ignored


def test_the_mean_of_fits_goes_by_what_each_is_sure_of() -> None:
    assert mean_angle([10.0, 20.0], [5.0, 5.0], RULES.least_spread) == pytest.approx((15.0, 5.0), abs=0.1)
    mean, scatter = mean_angle([175.0, 5.0, 0.0], [2.0, 2.0, 2.0], RULES.least_spread)
    assert (mean + 90) % 180 == pytest.approx(90.0)
    assert scatter == pytest.approx(5 * math.sqrt(2 / 3), abs=0.1)
    # Three vague fits that are across, and a sure one later.
    mean, scatter = mean_angle([130.0, 130.0, 130.0, 40.0], [12.0, 12.0, 12.0, 1.5], RULES.least_spread)
    assert mean == pytest.approx(40.0)
    assert scatter > RULES.disagree
    # Surer than a degree is as sure as a degree.
    assert mean_angle([0.0, 20.0], [1.0, 0.01], RULES.least_spread)[0] == pytest.approx(10.0)


def test_pictures_whose_fits_do_not_agree_are_named(tmp_path: Path) -> None:
    scene, polarizers = unknown()
    fits = polarizers.fit(predicted).repeat(4, 1, 1)
    fits[:, :, 3] = 2.0
    polarizers.take(fits)
    assert not any(judgment.unsettled for judgment in polarizers.judgments())
    turned, seldom = 1, 3
    fits[:2, turned, 0] = (fits[:2, turned, 0] + 40.0) % 180.0
    fits[:3, seldom, 2:4] = torch.tensor([0.1, 60.0], dtype=fits.dtype)
    polarizers.take(fits)
    unsettled = [k for k, judgment in enumerate(polarizers.judgments()) if judgment.unsettled]
    assert unsettled == [turned, seldom]
    (warned,) = [text for text in reported(tmp_path, scene, polarizers) if "do not agree" in text]
    assert all(scene.train_views[k].name in warned for k in unsettled)


def test_pictures_that_are_explained_poorly_are_named(tmp_path: Path) -> None:
    """What is predicted of one view is another view's, so that its angle is sure, for all that it says, and wrong."""
    scene = select_exposures(WHOLE, "unknown")
    poor = scene.train_views[2].name

    def mixed(view: View) -> Tensor:
        stokes = predicted(view).clone()
        if view.name == poor:
            stokes[1:] = (
                0.3 * stokes[0] * torch.rand(2, *stokes.shape[1:], generator=torch.Generator().manual_seed(1))
            )
        return stokes

    polarizers = Polarizers(scene, STOKES, STEPS)
    fits = polarizers.fit(predicted)[None]
    fits[..., 5:7] = torch.tensor([0.05, 0.2], dtype=fits.dtype)  # of a model that is not perfect
    polarizers.take(fits)
    assert not any(judgment.poorly_explained for judgment in polarizers.judgments())
    row = [judgment.view for judgment in polarizers.judgments()].index(poor)
    fits[0, row, 5:7] = polarizers.fit(mixed)[row, 5:7]
    polarizers.take(fits)
    found = polarizers.judgments()
    misfit, across = fits[0, row, 5:7].tolist()
    assert found[row].unexplained == pytest.approx(misfit / 0.05 * misfit / across)
    assert [judgment.view for judgment in found if judgment.poorly_explained] == [poor]
    told = reported(tmp_path, scene, polarizers)
    assert [poor in text for text in told if "turned by 90 degrees" in text] == [True]


def test_a_guess_is_better_than_a_photograph(tmp_path: Path) -> None:
    scene, polarizers = unknown()
    fits = polarizers.fit(predicted).repeat(4, 1, 1)
    sure, guessed, lost = 0, 1, 2
    fits[:, :, 3] = 2.0
    fits[:, guessed, 3] = 30.0
    fits[:, lost, 3] = 60.0
    polarizers.take(fits)
    found = polarizers.judgments()
    assert [found[k].vague for k in (sure, guessed, lost)] == [False, True, True]
    assert found[guessed].believed.angle == pytest.approx(found[guessed].angle)
    assert found[lost].believed == found[lost].specified
    # One that tells its angle now and then is not mixed with guesses.
    fits[0, guessed, 0] = (fits[0, guessed, 0] + 50.0) % 180.0
    fits[0, guessed, 3] = 4.0
    polarizers.take(fits)
    assert polarizers.judgments()[guessed].angle == pytest.approx(float(fits[0, guessed, 0]))
    fits[0] = fits[1]
    polarizers.take(fits)
    told = reported(tmp_path, scene, polarizers)
    for number, what in ((guessed, "the most likely one is used"), (lost, "used as photographs")):
        assert any(scene.train_views[number].name in text and what in text for text in told)


def test_swapped_pictures_and_missing_filters_are_named(tmp_path: Path) -> None:
    ones = select_exposures(WHOLE, "one")
    plain = {view.name: view for view in select_exposures(WHOLE, "none").views}
    views = [plain[v.name] if v.name == "v3" else v for v in ones.views]
    said = {"v1": Exposure(90.0), "v3": Exposure(45.0), "v4": Exposure(135.0)}  # true: 0, none, 135
    polarizers = judged(with_exposures(dataclasses.replace(ones, views=tuple(views)), **said))
    found = {judgment.view: judgment for judgment in polarizers.judgments()}
    assert [name for name, judgment in found.items() if judgment.contradicts] == ["v1"]
    assert abs(abs(found["v1"].estimate.off) - 90) < 1
    assert [name for name, judgment in found.items() if judgment.unfiltered] == ["v3"]
    assert polarizers.believed(ones.view("v1")).exposures == (Exposure(90.0),)  # it is said, so it holds
    warned = "\n".join(reported(tmp_path, ones, polarizers))
    assert "1 of 5 pictures (v3#0) look as if taken without a filter" in warned
    assert "1 of 5 pictures (v1#0) contradict their angles: v1#0 is specified at 90 degrees" in warned
    lines = {item.view: item.exposure for item in read_table(tmp_path / "angles.csv")}
    assert lines["v4"].angle == 135


def test_only_what_is_an_exception_contradicts(tmp_path: Path) -> None:
    """A fit is evidence as far as those of the other pictures agree with their angles."""
    scene = select_exposures(WHOLE, "one")
    polarizers = Polarizers(scene, STOKES, STEPS)
    right = polarizers.fit(predicted)[None]
    right[..., 3] = 2.0

    def told(*off: float) -> tuple[list[int], str]:
        fits = right.clone()
        fits[0, :, 0] = (fits[0, :, 0] + torch.tensor(off, dtype=fits.dtype)) % 180.0
        polarizers.take(fits)
        contradicting = [k for k, j in enumerate(polarizers.judgments()) if j.contradicts]
        return contradicting, "\n".join(reported(tmp_path, scene, polarizers))

    assert told(2, -3, 80, 4, -2)[0] == [2]
    assert told(2, -3, 45, 4, -2)[0] == [2]
    assert told(2, -3, 15, 4, -2)[0] == []
    right[0, 2, 3] = 20.0  # a picture at a wrong angle hardly tells its own
    assert told(2, -3, 65, 4, -2)[0] == [2]
    assert told(2, -3, 55, 4, -2)[0] == []
    right[0, 2, 3] = 2.0
    found, said = told(12, -14, 45, 10, -11)  # the model is 12 degrees off as a rule
    assert (found, "were not checked" in said) == ([], False)
    found, said = told(-70, 40, 85, -35, 60)  # it knows nothing yet
    assert (found, "contradict" in said, "known angles were not checked" in said) == ([], False, True)


@pytest.mark.parametrize(("places", "contradicting"), [((5,), []), ((5, 7), [5, 7]), ((4, 5), [])])
def test_of_four_pictures_only_exchanged_ones_contradict(
    places: tuple[int, ...], contradicting: list[int]
) -> None:
    """A single wrong angle would break the pair sums; those of 45 and 135 degrees are places 5 and 7."""
    views = tuple(dataclasses.replace(view, mount="filter") for view in WHOLE.views)
    polarizers = Polarizers(dataclasses.replace(WHOLE, views=views), STOKES, STEPS)
    fits = polarizers.fit(predicted)[None]
    fits[..., 3] = 2.0
    for place in places:
        fits[0, place, 0] = (fits[0, place, 0] + 90.0) % 180.0
    polarizers.take(fits)
    assert [k for k, judgment in enumerate(polarizers.judgments()) if judgment.contradicts] == contradicting


def test_where_most_angles_are_doubtful_it_says_what_to_do(tmp_path: Path) -> None:
    scene, polarizers = unknown()
    fits = polarizers.fit(predicted)[None]
    fits[..., 3] = 2.0
    for doubtful in (2, 3):
        fits[:, :doubtful, 3] = 30.0
        polarizers.take(fits)
        said = "\n".join(reported(tmp_path, scene, polarizers))
        assert f"angles found for 5 of 5 pictures; {doubtful} of 5 are doubtful" in said
        assert ("--angles none" in said) == (2 * doubtful > 5)
        assert (tmp_path / "angles.csv").read_text().count("doubtful") == doubtful
    assert read_table(tmp_path / "angles.csv")


def test_exposure_times_are_found() -> None:
    scene = select_exposures(WHOLE, "unknown")
    brighter = [
        dataclasses.replace(view, pictures=(view.codes.to(torch.int32) * 3 // 4).to(torch.uint16))
        if view.name == "v2"
        else view
        for view in scene.views
    ]
    polarizers = judged(dataclasses.replace(scene, views=tuple(brighter)))
    gains = {judgment.view: judgment.gain for judgment in polarizers.judgments()}
    assert gains["v2"] == pytest.approx(0.75, abs=0.01)
    assert gains["v1"] == pytest.approx(1.0, abs=0.01)


def begun(
    scene: Scene, state: TrainingState | None = None, recipe: Recipe = STOKES, **settings: bool
) -> TrainingLoop:
    given = TrainSettings(steps=STEPS, background="scene", **settings)  # type: ignore[arg-type]
    return gaussian_training(context_of(scene, recipe, given), state)[0]


def trained(scene: Scene, until: int = STEPS, state: TrainingState | None = None) -> dict[str, Tensor]:
    """The state that a training leaves."""
    trainer = begun(scene, state)
    run(trainer, until)
    return {name: values.clone() for name, values in trainer.state.tensors().items()}


def test_it_begins_again_with_the_angles_that_it_found() -> None:
    scene = select_exposures(WHOLE, "unknown")
    trainer = begun(scene)
    first, second = round(0.65 * STEPS), round(RULES.again[-1] * STEPS)
    search = first + second
    assert (fits_of(trainer).begins_again, trainer.total) == (True, STEPS + search)
    reports = run(trainer)
    assert [report.step for report in reports] == [*range(first), *range(second), *range(STEPS)]
    assert [report.done for report in reports] == [*range(1, STEPS + search + 1)]
    assert trainer.done == trainer.total
    assert len(fits_of(trainer).polarizers.table) == 4 + len(RULES.again)

    # After the searches it is a training that has been told these angles, and keeps to them.
    state, whole = begun(scene).state, trainer.state.tensors()
    state.angles = fits_of(trainer).polarizers.table
    assert different(whole, trained(scene, state=state)) == []

    alongside = begun(scene, begin_again=False)
    assert alongside.total == STEPS
    run(alongside)
    assert "gaussians.means" in different(whole, alongside.state.tensors())


def test_angles_are_sought_in_few_steps_on_small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    quick = dataclasses.replace(
        STOKES, angle_rules=dataclasses.replace(RULES, search_steps=20, search_size=16)
    )
    scene = select_exposures(WHOLE, "unknown")
    width = scene.views[0].camera.width
    assert width > 16
    trainer = begun(scene, recipe=quick)
    assert trainer.total == STEPS + 13 + 19
    looked_at = set[int]()
    fit = fits_of(trainer).polarizers.fit

    def seen(predict: Callable[[View], Tensor]) -> Tensor:
        def watched(view: View) -> Tensor:
            stokes = predict(view)
            looked_at.add(stokes.shape[2])
            return stokes

        return fit(watched)

    monkeypatch.setattr(fits_of(trainer).polarizers, "fit", seen)
    run(trainer)
    assert looked_at == {width // -(-width // 16)}
    assert trainer.done == trainer.total
    # What was found holds for the pictures in full size.
    view = trainer.context.scene.train_views[0]
    assert fits_of(trainer).polarizers.believed(view).codes is view.codes
    # On a schedule that tells nothing of a search, known angles are looked at three times.
    known = fits_of(begun(select_exposures(WHOLE, "one"))).polarizers
    assert [step for step in range(STEPS) if known.due(step)] == [8, 12, 20]


@pytest.mark.parametrize("exposures", ["one", "four", "none"])
def test_where_all_angles_are_known_nothing_begins_again(exposures: str) -> None:
    trainer = begun(select_exposures(WHOLE, exposures))  # type: ignore[arg-type]
    assert (fits_of(trainer).begins_again, trainer.total) == (False, STEPS)


@pytest.mark.parametrize("until", [STEPS // 2, 23, 27, 39])
def test_a_resumed_training_gives_the_same_bits(until: int) -> None:
    scene = select_exposures(WHOLE, "unknown")
    stored = trained(scene, until)
    refuse_foreign(stored, STOKES)
    resumed = trained(scene, state=TrainingState.from_tensors(stored, STOKES))
    assert "angles" in resumed
    assert different(resumed, whole_of_unknown()) == []


@functools.cache
def whole_of_unknown() -> dict[str, Tensor]:
    """What an uninterrupted training of unknown angles leaves."""
    return trained(select_exposures(WHOLE, "unknown"))


@pytest.mark.parametrize("exposures", ["three", "two", "one", "mixed", "none", "sparse"])
def test_all_captures_train(exposures: str) -> None:
    state = trained(select_exposures(WHOLE, exposures))  # type: ignore[arg-type]
    assert all(bool(values.isfinite().all()) for values in state.values())


def test_four_pictures_train_as_ever() -> None:
    listed = [
        dataclasses.replace(view, exposures=tuple(Exposure(float(e.angle or 0)) for e in FOUR))
        for view in WHOLE.views
    ]
    assert different(trained(dataclasses.replace(WHOLE, views=tuple(listed))), trained(WHOLE)) == []


def test_the_fits_of_the_latest_search_hold() -> None:
    _, polarizers = unknown(search=STEPS)
    fit = polarizers.fit(predicted)
    fit[:, 3] = 2.0
    first, second = fit.clone(), fit.clone()
    first[:, 0], second[:, 0] = 10.0, 30.0
    polarizers.take(first.repeat(4, 1, 1))
    assert (polarizers.ended, polarizers.settled) == (1, False)
    assert [judgment.angle for judgment in polarizers.judgments()] == pytest.approx([10.0] * len(fit))
    polarizers.take(torch.cat((first.repeat(4, 1, 1), second.repeat(len(RULES.again), 1, 1))))
    assert polarizers.settled
    assert [judgment.angle for judgment in polarizers.judgments()] == pytest.approx([30.0] * len(fit))
