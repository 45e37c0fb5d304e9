"""Stages laid over steps. No number of a real recipe appears here."""

from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any

import pytest
from faults import Fault

from polarguide.methods import RECIPES
from polarguide.training.recipe import Recipe, Repeat, Rounds, Schedule, Stage
from polarguide_bench.recipes import ABLATIONS, recipe_named

OF_GAUSSIANS = {name: recipe for name, recipe in RECIPES.items() if isinstance(recipe, Recipe)}
EVERY_RECIPE = pytest.mark.parametrize("recipe", OF_GAUSSIANS.values(), ids=OF_GAUSSIANS.keys())

RESET = Repeat("reset_opacity", fraction=0.06)
TURNS = Rounds(("propagate_normals", "propagate_normals", "reset_opacity"), fraction=0.02)
REFRESH = Repeat("refresh_priors", fraction=0.03)
RECIPE = Recipe(
    name="three",
    about="",
    stages=(
        Stage("first", 0.2, reflection=False),
        Stage("second", 0.5, True, repeats=(RESET, REFRESH), on_enter=("refresh_priors",)),
        Stage("third", 0.3, reflection=True),
    ),
    rates={"means": 2.0},
    means_decay=0.25,
    sh_fractions=(0.1, 0.4, 0.5),
)


def names(steps: int) -> list[str]:
    schedule = Schedule(RECIPE, steps)
    return [schedule.at(step).stage.name for step in range(steps)]


@pytest.mark.parametrize("steps", [10, 100, 1000, 30_000])
def test_boundaries_scale_with_the_steps(steps: int) -> None:
    stages = names(steps)
    assert stages.count("first") == steps // 5
    assert stages.count("second") == steps // 2
    assert stages == sorted(stages, key=["first", "second", "third"].index)


@pytest.mark.parametrize("steps", range(1, 12))
@EVERY_RECIPE
def test_what_a_stage_begins_with_happens_in_the_shortest_training(recipe: Recipe, steps: int) -> None:
    schedule = Schedule(recipe, steps)
    happened = [action for step in range(steps) for action in schedule.at(step).actions]
    assert {action for stage in recipe.stages for action in stage.on_enter} <= {*happened}
    assert schedule.at(steps - 1).stage is recipe.stages[-1]


def test_actions_are_due_at_their_distance_from_the_stage_start() -> None:
    schedule = Schedule(RECIPE, 100)
    due = {step: schedule.at(step).actions for step in range(100) if schedule.at(step).actions}
    assert due[20] == ("refresh_priors",), "on entering"
    assert [s for s, actions in due.items() if "reset_opacity" in actions] == [26, 32, 38, 44, 50, 56, 62, 68]
    assert [s for s, actions in due.items() if "refresh_priors" in actions] == [20, *range(23, 70, 3)]
    assert min(due) == 20
    assert max(due) < 70


def test_rounds_fill_their_stage_evenly_and_end_before_the_next() -> None:
    turning = replace(RECIPE.stages[1], rounds=TURNS, repeats=(REFRESH,))
    schedule = Schedule(replace(RECIPE, stages=(RECIPE.stages[0], turning, RECIPE.stages[2])), 120)
    # 60 steps from the 24th on, turns at least 2 apart: ten whole rounds.
    due = {s: a for s in range(120) for a in schedule.at(s).actions if a != "refresh_priors"}
    assert list(due) == list(range(26, 84, 2))
    assert list(due.values()) == [TURNS.actions[k % 3] for k in range(29)]
    assert schedule.at(28).actions == ("propagate_normals", "refresh_priors")


@pytest.mark.parametrize("length", [1, 2, 3, 7, 60, 61, 1000])
@pytest.mark.parametrize("minimum", [1, 50, 5000])
def test_turns_are_as_far_apart_as_asked_for_unless_there_is_but_one_round(length: int, minimum: int) -> None:
    places = [0, *Rounds(TURNS.actions, 0.02, minimum).turns(length, 2 * length), length]
    gaps = [after - before for before, after in pairwise(places)]
    assert min(gaps) >= (max(minimum, round(0.04 * length)) - 1 if len(gaps) > 3 else length // 3)
    assert max(gaps) - min(gaps) <= 1 or length < 3


def test_the_last_turn_belongs_to_what_follows() -> None:
    assert Rounds(TURNS.actions, 0.1, 100).turns(300, 1000) == {
        100: "propagate_normals",
        200: "propagate_normals",
    }


def test_a_repeat_keeps_its_minimum_distance_and_is_never_closer_than_one_step() -> None:
    assert Schedule(RECIPE, 3).period(REFRESH) == 1
    close = replace(RESET, minimum=17)
    recipe = replace(RECIPE, stages=(Stage("only", 1.0, True, repeats=(close,)),))
    schedule = Schedule(recipe, 100)
    assert [s for s in range(100) if schedule.at(s).actions] == [17, 34, 51, 68, 85]
    assert Schedule(recipe, 10_000).period(close) == 600


def test_harmonics_begin_at_their_shares() -> None:
    schedule = Schedule(RECIPE, 200)
    degrees = [schedule.sh_degree(step) for step in range(200)]
    assert [degrees.index(degree) for degree in range(4)] == [0, 20, 80, 100]
    assert degrees == sorted(degrees)


def test_rate_of_the_means_decays_to_its_last_share() -> None:
    schedule = Schedule(RECIPE, 101)
    assert [schedule.rates(step)["means"] for step in (0, 50, 100)] == pytest.approx([2.0, 1.0, 0.5])
    assert Schedule(RECIPE, 1).rates(0) == {"means": 2.0}


def test_a_stage_changes_the_rates_that_it_names_while_it_lasts() -> None:
    first, second, third = RECIPE.stages
    slow = replace(second, rate_factors={"quaternions": 0.25})
    recipe = replace(
        RECIPE, stages=(first, slow, third), rates={"means": 2.0, "quaternions": 8.0, "sh_dc": 3.0}
    )
    schedule = Schedule(recipe, 100)
    assert [schedule.rates(step)["quaternions"] for step in (0, 19, 20, 69, 70, 99)] == [8, 8, 2, 2, 8, 8]
    assert all(schedule.rates(step)["sh_dc"] == 3 for step in range(100))
    assert schedule.rates(30)["means"] == Schedule(RECIPE, 100).rates(30)["means"]


@pytest.mark.parametrize(
    ("fields", "expected", "found"),
    [
        ({"stages": (replace(RECIPE.stages[0], fraction=0.4), *RECIPE.stages[1:])}, "add up to 1", "1.2"),
        ({"stages": (replace(RECIPE.stages[0], fraction=0.6), *RECIPE.stages[1:])}, "add up to 1", "1.4"),
        ({"rates": {"sh_dc": 1.0}}, "means", "sh_dc"),
        (
            {"stages": (replace(RECIPE.stages[0], fraction=1.0, rate_factors={"quaternion": 0.2}),)},
            "learned parameters",
            "'quaternion'",
        ),
    ],
)
def test_stages_that_do_not_cover_the_steps_and_rates_of_nothing_are_refused(
    fields: dict[str, Any], expected: str, found: str
) -> None:
    Fault("recipe three", expected, found).raised_by(replace, RECIPE, **fields)


@EVERY_RECIPE
def test_fractions_of_every_recipe_add_up(recipe: Recipe) -> None:
    assert sum(stage.fraction for stage in recipe.stages) == pytest.approx(1.0, abs=1e-6)
    assert all(stage.fraction > 0 for stage in recipe.stages)
    Schedule(recipe, 1000)


@EVERY_RECIPE
def test_every_recipe_is_named_described_and_trains_what_it_renders(recipe: Recipe) -> None:
    assert RECIPES[recipe.name] is recipe
    assert recipe.about.endswith(".")
    core = {"means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest"}
    assert core <= set(recipe.rates)
    assert all(set(stage.rate_factors) <= set(recipe.rates) for stage in recipe.stages)
    assert set(recipe.learning_rates) == set(recipe.shapes) - {
        "outward",
        "surface",
        "metalness",
        "index_offset",
    }
    assert ("specular" in recipe.shading.layers) == any(stage.reflection for stage in recipe.stages)
    assert ("specular" in recipe.shading.layers) == bool(recipe.light_rates)
    assert list(recipe.sh_fractions) == sorted(recipe.sh_fractions)


@EVERY_RECIPE
def test_priors_are_refreshed_before_a_stage_that_uses_them(recipe: Recipe) -> None:
    """A stage compares with priors only where it, or one before it, refreshes them."""
    for number, stage in enumerate(recipe.stages):
        begun = recipe.stages[: number + 1]
        assert not stage.weights.priors or any("refresh_priors" in s.on_enter for s in begun), stage.name


def upheavals(name: str, steps: int) -> dict[str, list[int]]:
    """When opacities are reset and normals propagated."""
    schedule = Schedule(recipe_named(name), steps)
    return {
        action: [step for step in range(steps) if action in schedule.at(step).actions]
        for action in ("reset_opacity", "propagate_normals")
    }


@pytest.mark.parametrize(
    ("steps", "propagations", "resets"),
    [
        (1500, [369], [590]),
        (2500, [615], [984]),
        (5000, [861, 1598], [1230, 1967]),
        (
            61_000,
            list(range(7500, 24_000, 3000)),
            list(range(9000, 28_000, 3000)),
        ),  # resets as in the release
    ],
)
@pytest.mark.parametrize("name", ["3dgs-dr", "polarguide-paper", "polarguide-paper:kind"])
def test_when_3dgs_dr_resets_and_propagates(
    name: str, steps: int, propagations: list[int], resets: list[int]
) -> None:
    assert upheavals(name, steps) == {"propagate_normals": propagations, "reset_opacity": resets}


@pytest.mark.parametrize("name", [*OF_GAUSSIANS, "polarguide-paper:kind"])
@pytest.mark.parametrize("steps", [300, 1500, 2500, 5000, 9999, 61_000])
def test_a_scene_can_heal_between_resets_and_propagations(name: str, steps: int) -> None:
    """Also across stages: a tenth of the steps, or 350."""
    places = sorted(step for found in upheavals(name, steps).values() for step in found)
    gaps = [after - before for before, after in pairwise(places)]
    assert min(gaps, default=steps) >= min(0.098 * steps - 1, 350)


def test_without_propagation_nothing_is_propagated_or_reset() -> None:
    assert upheavals("3dgs-dr:without-propagation", 5000) == {"reset_opacity": [], "propagate_normals": []}
    base, bare = RECIPES["3dgs-dr"], recipe_named("3dgs-dr:without-propagation")
    assert [(s.name, s.fraction, s.weights) for s in base.stages] == [
        (s.name, s.fraction, s.weights) for s in bare.stages
    ]


def test_an_ablation_changes_something_and_is_found_by_its_name() -> None:
    for base, variations in ABLATIONS.items():
        names = [recipe.name for recipe in variations]
        assert len(set(names)) == len(names)
        for recipe in variations:
            assert recipe.name.startswith(base + ":")
            assert recipe.about.endswith(".")
            assert recipe_named(recipe.name) == recipe
            reference = recipe_named(base)
            same = replace(recipe, name=base, about=reference.about)
            assert same != reference, recipe.name
            if isinstance(recipe, Recipe):
                Schedule(recipe, 1000)


@pytest.mark.parametrize(
    ("name", "terms"),
    [
        ("polarguide:only-normals", {"specular", "diffuse"}),
        ("polarguide:without-normals", {"azimuth", "chromatic", "consistency"}),
        ("polarguide:without-colour", {"chromatic"}),
        ("polarguide:without-flatness", {"flatness"}),
        ("polarguide-stokes:without-stokes", {"stokes"}),
        ("polarguide-stokes:without-separation", {"specular", "diffuse"}),
        ("polarguide-stokes:without-normals", {"azimuth", "chromatic", "consistency"}),
        ("polarguide-stokes:without-consistency", {"consistency"}),
        ("polarguide:unpolarized", {"azimuth", "chromatic", "specular", "diffuse"}),
        ("polarguide:without-polar-normals", {"azimuth", "chromatic"}),
        ("polarguide-paper:only-normals", {"reflection", "base"}),
        ("polarguide-paper:without-normals", {"normal"}),
        ("polarguide-paper:unpolarized", {"normal", "reflection", "base"}),
        ("polarguide-paper:kind:only-normals", {"specular", "diffuse"}),
        ("polarguide-paper:kind:without-normals", {"normal"}),
        ("polarguide-paper:kind:unpolarized", {"normal", "specular", "diffuse"}),
        ("polarguide-stokes:unpolarized", {"azimuth", "chromatic", "specular", "diffuse", "stokes"}),
        (
            "polarguide-stokes:unpolarized-without-consistency",
            {"azimuth", "chromatic", "specular", "diffuse", "stokes", "consistency"},
        ),
    ],
)
def test_an_ablation_switches_off_its_terms_in_every_stage_and_no_other(name: str, terms: set[str]) -> None:
    base, variation = recipe_named(name.rpartition(":")[0]), recipe_named(name)
    changed: set[str] = set()
    for old, new in zip(base.stages, variation.stages, strict=True):
        before, after = asdict(old.weights), asdict(new.weights)
        assert all(after[term] == 0 for term in terms)
        changed |= {term for term in before if before[term] != after[term]}
        if "unpolarized" in name:
            old = _without_refresh(old)
        assert replace(new, weights=old.weights) == old
    assert changed == terms


def _without_refresh(stage: Stage) -> Stage:
    return replace(
        stage,
        repeats=tuple(r for r in stage.repeats if r.action != "refresh_priors"),
        on_enter=tuple(a for a in stage.on_enter if a != "refresh_priors"),
    )


@pytest.mark.parametrize("base", ["polarguide", "polarguide-stokes"])
def test_without_easing_the_final_stage_goes_on_as_the_one_before_it(base: str) -> None:
    *before, guided, final = recipe_named(f"{base}:without-easing").stages
    assert [*before, guided] == list(RECIPES[base].stages[:-1])
    assert final.weights == replace(guided.weights, specular=0.0, diffuse=0.0)
    assert final.rate_factors == {}
    eased = RECIPES[base].stages[-1]
    assert replace(final, weights=eased.weights, rate_factors=eased.rate_factors) == eased


@pytest.mark.parametrize(
    ("name", "known"),
    [("magic", "3dgs-dr, ref-gs, polarguide"), ("polarguide:magic", "polarguide:without-normals")],
)
def test_an_unknown_recipe_is_refused_with_the_names_there_are(name: str, known: str) -> None:
    Fault("recipe", known, name).raised_by(recipe_named, name)
