"""Metals are found by what all views measured."""

import dataclasses
from pathlib import Path

import pytest
import torch
from metal_balls import BODIES, METALS, gaussians_of_the_ball, measured, views_of
from torch import Tensor
from trainings import CPU, different, run

from polarguide.capture import Scene
from polarguide.raster.cpu import rasterize_cpu
from polarguide.recipes import RECIPES
from polarguide.runs.folder import load_checkpoint, resolve, save_checkpoint
from polarguide.shading.metal import any_nonzero
from polarguide.training.metals.evidence import Evidence, evidence, residuals
from polarguide.training.metals.observations import ViewSamples, contradicted, label_weights
from polarguide.training.metals.search import decide
from polarguide.training.rules import MetalRules
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import Trainer, warn_of_unused_materials

RULES = MetalRules()


def decided(found: Evidence, was: Tensor | None = None, *, allowed: bool = True) -> Tensor:
    """What becomes metal where all may, or nothing; by default there was no metal until now."""
    nothing = torch.zeros(len(found.ratio), dtype=torch.bool)
    return decide(found, nothing if was is None else was, nothing | allowed, RULES)


def rows(metal: Tensor) -> list[int]:
    return metal.nonzero()[:, 0].tolist()


@pytest.mark.parametrize("material", [*METALS, *BODIES])
def test_the_right_explanation_leaves_less(material: str) -> None:
    generator = torch.Generator().manual_seed(0)
    cosine = 0.35 + 0.6 * torch.rand(24, 40, generator=generator)
    seen = 0.1 + torch.rand(24, 40, 1, generator=generator).expand(24, 40, 3)
    s0, across, _ = measured(material, cosine, seen)
    found = residuals(ViewSamples(torch.ones(24, 40), s0, across, torch.zeros_like(s0), cosine), 1.5, RULES)
    dielectric, metal, reflectance = found
    if material in METALS:
        assert bool((metal < 0.1 * dielectric).all())
        assert float((reflectance - torch.tensor(METALS[material])).abs().max()) < 0.2
    else:
        assert float(dielectric.max()) < 1e-6
        assert bool((metal > dielectric).all())


@pytest.mark.parametrize("degree", [0.0, 0.2, 0.4, 0.6])
@pytest.mark.parametrize("material", [*METALS, *BODIES])
def test_balls_of_metal_are_found_and_no_others_also_in_polarized_light(material: str, degree: float) -> None:
    ball = gaussians_of_the_ball()
    found = evidence(ball, views_of(material, degree), rasterize_cpu, 1.5, RULES)
    seen = ball["means"][:, 2] > 0.1  # enough cameras look from above
    share = float(decided(found)[seen].float().mean())
    assert share == 0 if material in BODIES else share >= (0.5 if degree else 0.8)
    assert not bool(decided(found, allowed=False).any())


@pytest.mark.parametrize(
    ("material", "other", "most"), [("aluminum", "black", 0.02), ("chromium", "red", 0.005)]
)
def test_a_neighbor_of_a_metal_is_none(material: str, other: str, most: float) -> None:
    """The two halves of a ball meet; what is near the seam is judged by neighbors of like brightness and tint."""
    ball_of_two = gaussians_of_the_ball()
    found = evidence(ball_of_two, views_of(material, other=other), rasterize_cpu, 1.5, RULES)
    metal = decided(found)
    x, _, z = ball_of_two["means"].unbind(1)
    assert float(metal[(z > 0.1) & (x > 0.1)].float().mean()) > 0.8
    assert float(metal[(z > 0.1) & (x < -0.1)].float().mean()) < most


def test_oblique_polarization_has_to_be_much_and_to_explain_the_misfit() -> None:
    oblique, misfit, brightness, ratio = (torch.full((120,), v) for v in (0.01, 0.1, 1.0, 0.2))
    for begin in (5, 35, 65, 95):
        oblique[begin : begin + 20] = 0.09
    misfit[35:55] = 0.25
    brightness[65:85] = 0.3  # a dark body, of a light that is bright elsewhere
    ratio[95:115] = -0.2  # a dielectric fits better
    found = said(120, oblique=oblique, metal_misfit=misfit, brightness=brightness, ratio=ratio)
    assert rows(decided(found)) == list(range(5, 25))


def said(count: int, **values: Tensor) -> Evidence:
    """Evidence along a line of Gaussians that says nothing but what is given."""
    near = (torch.arange(count)[:, None] + torch.tensor([0, 1, -1, 2, -2])).clamp(0, count - 1)
    given = Evidence(
        ratio=torch.zeros(count),
        misfit=torch.full((count,), 0.1),
        reflectance=torch.full((count, 3), 0.6),
        near=near,
        alike=torch.ones(count, 5),
        brightness=torch.ones(count),
        tint=torch.ones(count),
        metal_misfit=torch.full((count,), 0.1),
        oblique=torch.zeros(count),
        support=torch.ones(count),
        labels=torch.zeros(count, 2),
    )
    return given._replace(**values)


def test_what_is_too_deeply_colored_is_no_metal_unless_the_user_says_so() -> None:
    ratio, tint, words = torch.full((60,), 3.0), torch.full((60,), 0.3), torch.zeros(60, 2)
    tint[20:] = 0.2
    words[50:, 1] = 5.0
    found = said(60, ratio=ratio, tint=tint, labels=words)
    assert rows(decided(found)) == [*range(20), *range(50, 60)]
    assert not bool(decided(found, torch.ones(60, dtype=torch.bool))[20:50].any())


@pytest.mark.parametrize(("material", "least", "most"), [("gold", 0.4, 0.75), ("red", 0.0, 0.4)])
def test_the_tint_is_that_of_the_material(material: str, least: float, most: float) -> None:
    """Half of the ball is gray, and so in part is the mean: by itself gold has 0.39, red paint 0.1 under its gloss."""
    half = gaussians_of_the_ball()
    found = evidence(half, views_of(material, other="aluminum"), rasterize_cpu, 1.5, RULES)
    x, _, z = half["means"].unbind(1)
    assert least < float(found.tint[(z > 0.1) & (x > 0.1)].median()) < most
    assert float(found.tint[(z > 0.1) & (x < -0.1)].median()) > 0.55


def test_metal_grows_where_it_is_likely_and_stays_where_it_was() -> None:
    ratio = torch.zeros(80)
    ratio[5:19], ratio[19:25], ratio[40:44], ratio[44:60], ratio[70] = 3.0, 1.0, 1.0, 3.0, 3.0
    assert rows(decided(said(80, ratio=ratio))) == [*range(5, 25), *range(40, 60)]  # one alone is none
    ratio[30:40], was = 0.35, torch.zeros(80, dtype=torch.bool)  # less than is likely
    was[30:40] = True
    assert rows(decided(said(80, ratio=ratio), was)) == [*range(5, 25), *range(40, 60)]
    other_way = torch.ones(80, 5)
    other_way[19:, 1:] = 0
    metal = rows(decided(said(80, ratio=ratio, alike=other_way)))
    assert metal[:14] == list(range(5, 19))
    assert not {*metal} & {*range(19, 25)}


@pytest.mark.parametrize(("evidence_left", "stays"), [(1.4, True), (1.0, False)])
def test_where_growth_does_not_reach_metal_stays_only_with_much_evidence(
    evidence_left: float, stays: bool
) -> None:
    """Each of a patch has one sure Gaussian among its 16 nearest: too few to join, enough to be of one piece."""
    ratio, was = torch.zeros(80), torch.zeros(80, dtype=torch.bool)
    ratio[:20], ratio[30:40], was[30:40] = 3.0, evidence_left, True
    own = torch.arange(80)[:, None]
    near = torch.cat((own, own + torch.tensor([1, -1, 2, -2]), torch.full((80, 11), 70)), dim=1).clamp(0, 79)
    near[30:40, 1:4] = torch.tensor([[5, 33, 36]])
    alike = torch.ones(80, 16)
    alike[:30, 5:] = alike[40:, 5:] = 0
    near[:, 4] = torch.where(torch.arange(80) // 10 == 3, 70, near[:, 4])
    found = said(80, ratio=ratio, near=near, alike=alike)
    expected = [*range(20), *(range(30, 40) if stays else ())]
    assert rows(decided(found, was)) == expected


def test_what_lies_among_metal_joins_unless_a_dielectric_is_clearly_better() -> None:
    ratio, tint = torch.full((90,), -1.0), torch.ones(90)
    ratio[5:80] = 3.0
    ratio[20:22], ratio[40:42], ratio[60:62], tint[60:62] = -0.5, -0.9, -0.5, 0.1
    assert rows(decided(said(90, ratio=ratio, tint=tint))) == [*range(5, 40), *range(42, 60), *range(62, 80)]


def test_pieces_of_which_little_is_sure_are_none() -> None:
    """As a plate in polarized light looks: a few Gaussians just beyond the limit, and many that are likely."""
    ratio = torch.zeros(300)
    ratio[10:22], ratio[22:100] = 2.3, 1.4
    ratio[150:170], ratio[170:220] = 2.3, 1.4
    ratio[250:256] = 4.0  # too few to be told
    was = torch.zeros(300, dtype=torch.bool)
    was[10:100] = was[150:220] = True
    metal = decided(said(300, ratio=ratio), was)
    assert not bool(metal[:140].any())
    assert bool(metal[150:170].all())
    assert not bool(metal[240:].any())


def test_what_the_user_says_counts() -> None:
    ratio, words = torch.zeros(60), torch.zeros(60, 2)
    ratio[5:35] = 3.0
    words[18:60, 0] = 5.0
    words[50:53] = torch.tensor([1.0, 5.0])
    assert rows(decided(said(60, ratio=ratio, labels=words))) == [*range(5, 18), 50, 51, 52]


RECIPE = RECIPES["polarguide-stokes"]


def with_materials(scene: Scene, kind: int) -> Scene:
    """The scene with everything of one material."""
    views = tuple(
        dataclasses.replace(view, materials=torch.full(view.invalid.shape, kind, dtype=torch.uint8))
        for view in scene.views
    )
    return dataclasses.replace(scene, views=views)


def trainer_of(scene: Scene, settings: TrainSettings, warn: list[str]) -> Trainer:
    repeats = tuple(
        dataclasses.replace(stage, repeats=tuple(dataclasses.replace(r, minimum=1) for r in stage.repeats))
        for stage in RECIPE.stages
    )
    recipe = dataclasses.replace(RECIPE, stages=repeats)
    return Trainer(scene, recipe, resolve(settings, scene, recipe), CPU, warn=warn.append)


def test_training_makes_metals_of_what_the_user_says(tiny_scene: Scene, tmp_path: Path) -> None:
    """And goes on from between two looks, or from after the last, with the same bits."""
    scene, heard = with_materials(tiny_scene, 2), []
    settings = TrainSettings(60, 3)
    whole = trainer_of(scene, settings, heard)
    for until in (32, 45):
        run(whole, until)
        assert any_nonzero(whole.state.gaussians["metalness"])
        (tmp_path / str(until)).mkdir()
        save_checkpoint(tmp_path / str(until), whole.state)
    assert not heard
    run(whole)
    for until in (32, 45):
        resumed = trainer_of(scene, settings, heard)
        resumed.state = load_checkpoint(tmp_path / str(until), RECIPE)
        run(resumed)
        assert different(whole.state.tensors(), resumed.state.tensors()) == [], until


def test_dielectric_turns_the_search_off(tiny_scene: Scene) -> None:
    trainer = trainer_of(with_materials(tiny_scene, 2), TrainSettings(60, 3, materials="dielectric"), [])
    trainer.run(lambda _: None)
    assert not any_nonzero(trainer.state.gaussians["metalness"])


@pytest.mark.parametrize("minimum", [1, 1000])
def test_too_few_steps_to_heed_materials_are_told_of(tiny_scene: Scene, minimum: int) -> None:
    heard: list[str] = []
    stages = tuple(
        dataclasses.replace(s, repeats=tuple(dataclasses.replace(r, minimum=minimum) for r in s.repeats))
        for s in RECIPE.stages
    )
    recipe, scene = dataclasses.replace(RECIPE, stages=stages), with_materials(tiny_scene, 2)
    for given in (scene, tiny_scene):
        settings = resolve(TrainSettings(60, 3), given, recipe)
        warn_of_unused_materials(given, recipe, settings, CPU, heard.append)
    expected = [] if minimum == 1 else ["materials/ is read at refreshes of the priors"]
    assert [words.partition(" between")[0] for words in heard] == expected


def test_contradicting_files_are_named_once(tiny_scene: Scene) -> None:
    scene, heard = with_materials(tiny_scene, 2), []
    wrong = scene.train_views[1]
    views = tuple(
        dataclasses.replace(view, materials=torch.ones_like(view.materials))
        if view.name == wrong.name and view.materials is not None
        else view
        for view in scene.views
    )
    trainer = trainer_of(dataclasses.replace(scene, views=views), TrainSettings(60, 3), heard)
    trainer.run(lambda _: None)
    assert len(heard) == 1
    assert f"materials/{wrong.name}.png" in heard[0]
    assert "in one view, metal in another" in heard[0]


def test_who_contradicts_whom() -> None:
    """Of a ball that is metal in all files: one calls its right half dielectric, another says nothing."""
    views = [
        dataclasses.replace(view, materials=torch.where(view.invalid, 0, 2).to(torch.uint8))
        for view in views_of("gold")
    ]
    half = views[3].materials
    half[:, half.shape[1] // 2 :][half[:, half.shape[1] // 2 :] == 2] = 1
    views[4] = dataclasses.replace(views[4], materials=None)
    of_the_ball = gaussians_of_the_ball()
    found = contradicted(
        of_the_ball, views, rasterize_cpu, label_weights(of_the_ball, views, rasterize_cpu), RULES
    )
    assert list(found) == ["v03"]
    assert 0.35 < found["v03"] < 0.65
    # Of two that say opposite things, each is contradicted by the other wherever both see the ball.
    opposed = [
        dataclasses.replace(views[k], materials=torch.where(views[k].invalid, 0, kind).to(torch.uint8))
        for k, kind in ((0, 1), (1, 2))
    ]
    found = contradicted(
        of_the_ball, opposed, rasterize_cpu, label_weights(of_the_ball, opposed, rasterize_cpu), RULES
    )
    assert min(found["v00"], found["v01"]) > 0.99


def test_the_users_words_need_no_polarization(tiny_scene: Scene) -> None:
    """Single pictures do not determine the Stokes vector; what the user calls metal is one all the same."""
    views = [
        dataclasses.replace(
            view,
            pictures=view.codes[:1],
            exposures=view.exposures[:1],
            materials=torch.where(view.invalid, 0, 2).to(torch.uint8),
        )
        for view in views_of("gold")[:6]
    ]
    assert not any(view.is_determined for view in views)
    ball = gaussians_of_the_ball()
    metal = decided(evidence(ball, views, rasterize_cpu, 1.5, RULES))
    assert float(metal[ball["means"][:, 2] > 0.3].float().mean()) > 0.9
    views = [dataclasses.replace(view, materials=None) for view in views]
    assert not bool(decided(evidence(ball, views, rasterize_cpu, 1.5, RULES)).any())
