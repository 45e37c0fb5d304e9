"""Metals are found by what all views measured."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from heard import Heard
from metal_balls import BODIES, METALS, gaussians_of_the_ball, measured, views_of
from torch import Tensor
from trainings import CPU, context_of, different, make_trainer, run

from polarguide import optics
from polarguide.capture import Scene, View
from polarguide.core.progress import Reporter
from polarguide.gaussians.gaussians import any_nonzero
from polarguide.methods import RECIPES
from polarguide.optics.fresnel import reflectances_from_cosine
from polarguide.raster.cpu import rasterize_cpu
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.runs.health import METALS_PICTURE, report_metals
from polarguide.runs.model import GaussianModel
from polarguide.training.angles.polarizers import gaussian_training
from polarguide.training.loop import TrainingLoop
from polarguide.training.metals.hypotheses import LEVELS, Setting, dielectric_terms, metal_fit
from polarguide.training.metals.observations import ViewSamples, contradicted, label_weights, shares
from polarguide.training.metals.search import (
    GOLD,
    INFINITE,
    SOFT_PRIORS,
    Graph,
    MetalEvidence,
    MetalSearch,
    _tint_cost,
    decide,
    evidence,
    looks,
    minimum_cut,
    neighbor_graph,
    surfaces,
    unary,
    warn_of_unused_materials,
)
from polarguide.training.recipe import MetalRules, MetalViews
from polarguide.training.settings import TrainSettings

RULES, LIMITS = MetalRules(), MetalViews()


def found(
    gaussians: dict[str, Tensor], views: list[View], *, allowed: bool = True, light: float = 1.5
) -> Tensor:
    """What becomes metal [N] where all may, or nothing."""
    measured_there = evidence(gaussians, views, rasterize_cpu, light, RULES, LIMITS)
    return decide(measured_there, gaussians, torch.full((len(gaussians["means"]),), allowed), RULES)


def samples_with(**given: Tensor) -> ViewSamples:
    """Samples of equal weight of a single normal, without polarization but for what is given."""
    s0 = given["s0"]
    plain = {
        "weight": torch.ones(s0.shape[:2]).to(s0),
        "across": torch.zeros_like(s0),
        "oblique": torch.zeros_like(s0),
        "noise": torch.zeros_like(s0),
        "normal": torch.tensor([0.0, 0.0, 1.0]).to(s0).expand_as(s0),
    }
    return ViewSamples(**{**plain, **given})


@pytest.mark.parametrize("material", [*METALS, *BODIES])
def test_errors_are_those_of_fresnels_equations(material: str) -> None:
    """What a material shows leaves no error of its own explanation, in double precision, and one of the other."""
    generator = torch.Generator().manual_seed(0)
    cosine = 0.35 + 0.6 * torch.rand(24, 40, generator=generator).double()
    light = 0.1 + torch.rand(24, 40, 1, generator=generator).double().expand(24, 40, 3)
    s0, across, _ = measured(material, cosine, light)
    samples = samples_with(s0=s0, across=across, cosine=cosine)
    setting = Setting(1.5, 0.5, 0.02)
    metal = metal_fit(samples, setting)
    dielectric = dielectric_terms(samples, setting).error()
    if material in METALS:
        assert bool((metal.error < 0.2 * dielectric).all())
        assert float((metal.reflectance - torch.tensor(METALS[material])).abs().max()) < 0.2
    else:
        assert float(dielectric.max()) < 1e-12
        assert bool((metal.error > 100 * dielectric).all())


@pytest.mark.parametrize(("light", "metal_alone"), [(0.1, True), (50.0, False)])
def test_oblique_polarization_excuses_whom_it_can_come_from(light: float, metal_alone: bool) -> None:
    """A metal keeps a large share of what it mirrors, a dielectric makes a small share of the scene's light."""
    cosine = torch.full((6, 1), 0.7).double()
    s0 = torch.full((6, 1, 3), 0.5).double()
    oblique = 0.1 * s0
    samples = samples_with(s0=s0, across=0.1 * s0, oblique=oblique, cosine=cosine)
    setting = Setting(1.5, light, 0.0)
    dielectric = float(dielectric_terms(samples, setting).error())
    assert (
        float(metal_fit(samples, setting).error) == 0
    )  # the metal is off across the plane by less than what is at 45 degrees
    s, p = reflectances_from_cosine(cosine[0], 1.5)
    most = float((s * p).sqrt()) * light
    assert dielectric >= 0.99 * max(0.0, 0.05 - most) ** 2 / 0.25
    assert (dielectric > 0) == metal_alone


def test_more_oblique_polarization_than_a_metal_keeps_is_an_error() -> None:
    """At 70 degrees no reflectance that is tried keeps 95 % of it."""
    cosine = torch.full((6, 1), math.cos(math.radians(70))).double()
    s0 = torch.full((6, 1, 3), 0.5).double()
    oblique = 0.95 * s0
    samples = samples_with(s0=s0, across=0.1 * s0, oblique=oblique, cosine=cosine)
    metal = metal_fit(samples, Setting(1.5, 0.1, 0.0))
    index = optics.conductor_index(torch.tensor(LEVELS).double())
    largest = float(optics.conductor_oblique_share(cosine[0], *index).abs().max())
    assert largest < 0.9
    assert float(metal.error) >= 0.99 * (0.95 - largest) ** 2


@pytest.mark.parametrize("degree", [0.0, 0.2, 0.4, 0.6])
@pytest.mark.parametrize("material", [*METALS, *BODIES])
def test_balls_of_metal_are_found_and_no_others_also_in_polarized_light(material: str, degree: float) -> None:
    ball = gaussians_of_the_ball()
    views = views_of(material, degree)
    seen = ball["means"][:, 2] > 0.1  # enough cameras look from above
    share = float(found(ball, views)[seen].float().mean())
    assert share == 0 if material in BODIES else share > 0.9
    assert not bool(found(ball, views, allowed=False).any())


@pytest.mark.parametrize("material", ["gold", "aluminum", *BODIES])
def test_noise_makes_no_metal(material: str) -> None:
    """Noise of 5 % of full scale polarizes pixels at random. Bright metals are still found."""
    generator = torch.Generator().manual_seed(0)
    views = []
    for view in views_of(material):
        codes = view.codes.to(torch.float32)
        noisy = codes + 0.05 * 65535 * torch.randn(codes.shape, generator=generator)
        views.append(dataclasses.replace(view, pictures=noisy.clamp(0, 65535).round().to(view.codes.dtype)))
    share = float(found(gaussians_of_the_ball(), views).float().mean())
    assert share > 0.8 if material in METALS else share < 0.02


@pytest.mark.parametrize(
    ("material", "other", "most"), [("aluminum", "black", 0.02), ("chromium", "red", 0.005)]
)
def test_a_neighbor_of_a_metal_is_none(material: str, other: str, most: float) -> None:
    """The two halves of a ball meet; neighbors of another color are not tied to each other."""
    ball_of_two = gaussians_of_the_ball(3600)
    ball_of_two["log_scales"] -= (
        0.7  # half as large: a boundary costs the less, the finer a surface is described
    )
    metal = found(ball_of_two, views_of(material, other=other))
    x, _, z = ball_of_two["means"].unbind(1)
    assert float(metal[(z > 0.1) & (x > 0.1)].float().mean()) > 0.8
    assert float(metal[(z > 0.1) & (x < -0.1)].float().mean()) < most


def random_graph(count: int, seed: int) -> tuple[np.ndarray, Graph]:
    """Evidence [N] and a graph with some pairs twice."""
    random = np.random.default_rng(seed)
    first, second = random.integers(0, count, (2, 3 * count))
    apart = first != second
    costs = random.integers(0, 200, apart.sum()) / 100
    return random.integers(-300, 300, count) / 100, Graph(first[apart], second[apart], costs)


def energy(metal: np.ndarray, nats: np.ndarray, graph: Graph) -> float:
    return float((graph.cost * (metal[graph.first] != metal[graph.second])).sum() - nats[metal].sum())


@pytest.mark.parametrize("seed", range(20))
def test_the_cut_has_the_least_energy_of_all(seed: int) -> None:
    nats, graph = random_graph(9, seed)
    if seed % 2:  # the user has said what two of them are
        nats[0], nats[1] = INFINITE, -INFINITE
    every = [np.array(kinds) for kinds in itertools.product((False, True), repeat=9)]
    least = min(energy(metal, nats, graph) for metal in every)
    metal = minimum_cut(nats, graph)
    assert energy(metal, nats, graph) == pytest.approx(least, abs=1e-6)
    if seed % 2:
        assert metal[0]
        assert not metal[1]


def test_a_piece_has_to_be_worth_a_surface() -> None:
    """Two pieces along a line, worth 30 and 60 less the 2 that each of their ends costs, and one of one Gaussian."""
    nats = np.full(60, -3.0)
    nats[5:15], nats[25:45], nats[50] = 3.0, 3.0, 3.0
    line = Graph(np.arange(59), np.arange(1, 60), np.full(59, 2.0))
    metal = minimum_cut(nats, line)
    assert metal.nonzero()[0].tolist() == [*range(5, 15), *range(25, 45)]
    for least, left in ((25.0, [*range(5, 15), *range(25, 45)]), (27.0, [*range(25, 45)]), (57.0, [])):
        assert surfaces(metal, nats, line, least).nonzero()[0].tolist() == left


def said(count: int, **values: Tensor) -> MetalEvidence:
    """Evidence that both explanations fit alike, but for what is given."""
    given = MetalEvidence(
        ratio=torch.zeros(count),
        views=torch.full((count,), 5.0),
        reflectance=torch.full((count, 3), 0.6),
        color=torch.full((count, 3), 0.5),
        labels=torch.zeros(count, 2),
    )
    return given._replace(**values)


def test_evidence_is_trusted_up_to_a_limit_and_the_user_without() -> None:
    ratio, labels = torch.tensor([50.0, -50.0, RULES.prior, 9.0, -9.0, 9.0]), torch.zeros(6, 2)
    labels[3, 0], labels[4, 1] = 1.0, 1.0
    allowed = torch.tensor([True] * 5 + [False])
    nats = unary(said(6, ratio=ratio, labels=labels), allowed, RULES).tolist()
    assert nats == pytest.approx(
        [RULES.trust, -RULES.trust, -RULES.prior, -INFINITE, INFINITE, -INFINITE], rel=1e-4
    )


@pytest.mark.parametrize(("weakest", "costs"), [(0.9, False), (GOLD + 0.01, False), (0.1, True)])
def test_no_metal_is_more_deeply_colored_than_gold(weakest: float, costs: bool) -> None:
    colors, weight = torch.full((100, 3), 0.5), torch.ones(100)
    colors[0, 2] = 0.5 * weakest
    cost = _tint_cost(colors, weight, RULES)
    assert (float(cost[0]) > 0.5) == costs
    assert not bool(cost[1:].any())


def test_a_border_between_two_hues_is_cheaper_than_between_two_brightnesses() -> None:
    """Neighbors differ by a factor of two: at one place only in the blue, elsewhere in all colors."""
    ball = gaussians_of_the_ball()
    count = len(ball["means"])
    color = torch.full((count, 3), 0.4)
    color[::2] *= 0.5
    hue = color.clone()
    hue[0, 2] = 2 * hue[0, 2]
    costs = []
    for colors in (color, hue):
        graph = neighbor_graph(ball, said(count, color=colors), RULES)
        costs.append(graph.cost[graph.first == 0].sum())
    assert costs[1] < 0.2 * costs[0]


def test_what_priors_decide_differently_is_a_mixture() -> None:
    """Two clusters of unlike color: one is worth the whole prior, the other a half of it."""
    gaussians = gaussians_of_the_ball()
    means, count = gaussians["means"], len(gaussians["means"])
    upper = means[:, 2] > 0
    measured = said(
        count,
        ratio=torch.where(upper, 3.0, 0.9) * RULES.prior,
        color=torch.where(upper, 0.9, 0.02)[:, None].expand(count, 3),
    )
    allowed = torch.ones(count, dtype=torch.bool)
    soft = decide(measured, gaussians, allowed, RULES, (1 / 3, 2 / 3, 1.0))
    hard = decide(measured, gaussians, allowed, RULES)
    torch.testing.assert_close(hard, upper.float())
    torch.testing.assert_close(soft, torch.where(upper, 1.0, 2 / 3))


RECIPE = RECIPES["polarguide-stokes"]


def with_materials(scene: Scene, kind: int) -> Scene:
    """The scene with everything of one material."""
    views = tuple(
        dataclasses.replace(view, materials=torch.full(view.invalid.shape, kind, dtype=torch.uint8))
        for view in scene.views
    )
    return dataclasses.replace(scene, views=views)


class Warnings(Reporter):
    """Keeps warnings in a list."""

    def __init__(self, kept: list[str]) -> None:
        self.warn = kept.append  # type: ignore[method-assign]


def trainer_of(scene: Scene, settings: TrainSettings, warn: list[str]) -> TrainingLoop:
    repeats = tuple(
        dataclasses.replace(stage, repeats=tuple(dataclasses.replace(r, minimum=1) for r in stage.repeats))
        for stage in RECIPE.stages
    )
    recipe = dataclasses.replace(RECIPE, stages=repeats)
    return gaussian_training(context_of(scene, recipe, settings, reporter=Warnings(warn)))[0]


def test_training_makes_metals_of_what_the_user_says(tiny_scene: Scene, tmp_path: Path) -> None:
    """And goes on from between two looks, or from after the last, with the same bits."""
    scene, heard = with_materials(tiny_scene, 2), []
    settings = TrainSettings(60, 3)
    whole = trainer_of(scene, settings, heard)
    for until in (32, 45):
        run(whole, until)
        assert any_nonzero(whole.state.gaussians, "metalness")
        (tmp_path / str(until)).mkdir()
        save_checkpoint(tmp_path / str(until), whole.state)
    assert not heard
    run(whole)
    for until in (32, 45):
        resumed = trainer_of(scene, settings, heard)
        resumed.begin(resumed.current, load_checkpoint(tmp_path / str(until), RECIPE))
        run(resumed)
        assert different(whole.state.tensors(), resumed.state.tensors()) == [], until


def test_dielectric_turns_the_search_off(tiny_scene: Scene) -> None:
    trainer = trainer_of(with_materials(tiny_scene, 2), TrainSettings(60, 3, materials="dielectric"), [])
    trainer.run()
    assert not any_nonzero(trainer.state.gaussians, "metalness")


@pytest.mark.parametrize("minimum", [1, 1000])
def test_too_few_steps_to_heed_materials_are_told_of(tiny_scene: Scene, minimum: int) -> None:
    heard: list[str] = []
    stages = tuple(
        dataclasses.replace(s, repeats=tuple(dataclasses.replace(r, minimum=minimum) for r in s.repeats))
        for s in RECIPE.stages
    )
    recipe, scene = dataclasses.replace(RECIPE, stages=stages), with_materials(tiny_scene, 2)
    for given in (scene, tiny_scene):
        warn_of_unused_materials(context_of(given, recipe, TrainSettings(60, 3), reporter=Warnings(heard)))
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
    trainer.run()
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
    shares = contradicted(
        of_the_ball, views, rasterize_cpu, label_weights(of_the_ball, views, rasterize_cpu), LIMITS
    )
    assert list(shares) == ["v03"]
    assert 0.35 < shares["v03"] < 0.65
    # Of two that say opposite things, each is contradicted by the other wherever both see the ball.
    opposed = [
        dataclasses.replace(views[k], materials=torch.where(views[k].invalid, 0, kind).to(torch.uint8))
        for k, kind in ((0, 1), (1, 2))
    ]
    shares = contradicted(
        of_the_ball, opposed, rasterize_cpu, label_weights(of_the_ball, opposed, rasterize_cpu), LIMITS
    )
    assert min(shares["v00"], shares["v01"]) > 0.99


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
    metal = found(ball, views)
    assert float(metal[ball["means"][:, 2] > 0.3].float().mean()) > 0.9
    views = [dataclasses.replace(view, materials=None) for view in views]
    assert not bool(found(ball, views).any())


def test_only_the_last_look_decides_hard(tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is likely is shaded as a mixture at first; at the last look the whole prior alone counts."""
    trainer = trainer_of(tiny_scene, TrainSettings(60, 3), [])
    steps = looks(trainer.context.recipe, trainer.settings)
    assert len(steps) >= 3
    priors: list[Sequence[float]] = []

    def decided_with(*given: object) -> Tensor:
        priors.append(given[-1])  # type: ignore[arg-type]
        return torch.zeros(len(trainer.state.gaussians))

    monkeypatch.setattr("polarguide.training.metals.search.decide", decided_with)
    trainer.run()
    assert priors == [SOFT_PRIORS] * (len(steps) - 1) + [(1.0,)]


@pytest.mark.parametrize("evidence", [0.9, 0.0, -0.6])
def test_weak_evidence_for_either_material_is_undecided(
    evidence: float, tiny_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the Gaussians has less evidence than the prior. It is reported and drawn until the user labels it."""
    recipe, heard = RECIPE, Heard()
    trainer = make_trainer(tiny_scene, recipe, 1500)
    gaussians = trainer.state.gaussians
    first = gaussians["means"][:, 0] > gaussians["means"][:, 0].median()
    values = {
        "ratio": torch.where(first, evidence, -2.0) * RULES.prior,
        "color": torch.where(first, 0.9, 0.02)[:, None].expand(-1, 3),
    }
    monkeypatch.setattr("polarguide.training.metals.search.evidence", lambda *_: said(len(first), **values))
    monkeypatch.setattr("polarguide.training.metals.search.far_away", lambda *_: torch.zeros_like(first))
    model = GaussianModel(trainer.state, trainer.current.shading, CPU)
    undecided = MetalSearch(trainer.current).undecided(trainer.state)
    assert undecided is not None
    torch.testing.assert_close(undecided, first)
    report_metals(tmp_path, tiny_scene, undecided, model, heard)
    assert heard.said[0].startswith("metals: 0.0 %")
    assert (tmp_path / METALS_PICTURE).exists()
    labels = torch.zeros(len(first), 2)
    labels[:, 0] = 1.0
    values["labels"] = labels
    undecided = MetalSearch(trainer.current).undecided(trainer.state)
    report_metals(tmp_path, tiny_scene, undecided, model, heard)
    assert not (tmp_path / METALS_PICTURE).exists()


def test_what_is_beside_a_label_has_none() -> None:
    """At the outline of a label its pixels show other Gaussians, too, in every view a little."""
    views = []
    for view in views_of("gold"):
        there = ~view.invalid
        labels = there.to(torch.uint8) * 2
        labels[:, labels.shape[1] // 2 :] = 0  # nothing is said of the right half
        views.append(dataclasses.replace(view, materials=labels))
    ball = gaussians_of_the_ball()
    one = [label_weights(ball, [view], rasterize_cpu) for view in views]
    for view, labels in zip(views, one, strict=True):
        everything = shares(ball, view.camera, torch.ones(*view.invalid.shape, 1), rasterize_cpu)[:, 0]
        labeled = labels[:, 1] > 0
        assert bool(labeled.any())
        assert bool((labels[labeled, 1] >= 0.5 * everything[labeled]).all())
    torch.testing.assert_close(label_weights(ball, views, rasterize_cpu), torch.stack(one).sum(dim=0))
