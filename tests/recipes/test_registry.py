"""Recipes of plug-ins: found by name, loaded when asked for, and refused in one line."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from faults import Fault
from plugins import install

from polarguide.methods import RECIPES, recipe_named
from polarguide.training.recipe import Stage
from polarguide_bench.recipes import ABLATIONS, ablations_of

MODULE = """
from dataclasses import replace
from polarguide.methods import RECIPES
ONE = replace(RECIPES["3dgs"], name="{name}", means_decay=0.5)
SEVERAL = [ONE, replace(ONE, name="{name}:slow", means_decay=0.1)]
NUMBER = 3
TAKEN = replace(ONE, name="3dgs")
RESERVED = replace(ONE, name="gnerp:mine")
def made(): return SEVERAL
def broken(): raise RuntimeError("no GPU here")
def ends(): raise SystemExit(0)
NAMED = replace(ONE, name=7)
LINES = replace(ONE, about="two\\nlines")
def rate(**rates): return replace(ONE, rates={{**ONE.rates, **rates}})
def function(): return rate(means=len)
def negative(): return rate(means=-1e-4)
def unknown(): return rate(colors=1e-3)
def endless(): return rate(means=float("inf"))
PRIORS = replace(ONE, priors=replace(ONE.priors, threshold="high"))
STAGES = replace(ONE, stages=tuple(replace(stage, hold_normals=3) for stage in ONE.stages))
"""


def module(monkeypatch: pytest.MonkeyPatch, folder: Path, name: str, what: str, *, entry: str = "") -> None:
    """A package of one module that offers ``what``."""
    site = folder / name
    install(monkeypatch, site, **{entry or name: f"plug_{name}:{what}"})
    (site / f"plug_{name}.py").write_text(MODULE.format(name=entry or name))
    monkeypatch.delitem(sys.modules, f"plug_{name}", raising=False)


@pytest.mark.parametrize("what", ["ONE", "SEVERAL", "made"])
def test_a_plug_ins_recipe_is_found_by_its_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, what: str
) -> None:
    name = f"mine-{what.lower()}"
    module(monkeypatch, tmp_path, what.lower(), what, entry=name)
    assert recipe_named(name) == replace(RECIPES["3dgs"], name=name, means_decay=0.5)
    assert [recipe.name for recipe in ablations_of(name)] == ([] if what == "ONE" else [f"{name}:slow"])


def test_a_built_in_name_loads_no_plug_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    module(monkeypatch, tmp_path, "idle", "ONE")
    assert recipe_named("polarguide") is RECIPES["polarguide"]
    assert ablations_of("polarguide") == ABLATIONS["polarguide"]
    assert ablations_of("ref-gs") == ()
    assert "plug_idle" not in sys.modules


@pytest.mark.parametrize(
    ("what", "found"),
    [
        ("NUMBER", "TypeError"),
        ("broken", "RuntimeError: no GPU here"),
        ("none", "AttributeError"),
        ("TAKEN", "3dgs, which is built in"),
        ("RESERVED", "gnerp:mine, which is built in"),
        ("ends", "SystemExit: 0"),
        ("NAMED", "7"),
        ("LINES", "two\\nlines"),
        ("function", "means = <built-in function len>"),
        ("negative", "means = -0.0001"),
        ("unknown", "found colors"),
        ("endless", "means = inf"),
        ("PRIORS", '"high"'),
        ("STAGES", "3"),
    ],
)
def test_a_plug_in_that_fails_is_named_when_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, what: str, found: str
) -> None:
    name = f"bad{what.lower()}"
    module(monkeypatch, tmp_path, name, what)
    for asked in (name, f"{name}:slow"):
        Fault(f"plug-in {name} (plug_{name}:{what})", "", found).raised_by(recipe_named, asked)
    Fault(found=f"plug-in {name}").raised_by(recipe_named, "nobodys")
    assert recipe_named("3dgs") is RECIPES["3dgs"]


@pytest.mark.parametrize(
    ("what", "field", "expected"),
    [
        ("NAMED", "(name)", "a line of text"),
        ("PRIORS", "(priors.threshold)", "a number"),
        ("STAGES", "(stages[0].hold_normals)", "true or false"),
    ],
)
def test_a_wrong_field_of_a_plug_ins_recipe_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, what: str, field: str, expected: str
) -> None:
    module(monkeypatch, tmp_path, f"field{what.lower()}", what)
    Fault(field, expected).raised_by(recipe_named, f"field{what.lower()}")


def test_two_plug_ins_of_one_name_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for part in ("first", "second"):
        module(monkeypatch, tmp_path, part, "ONE", entry="shared")
    Fault(found=":ONE and plug_").raised_by(recipe_named, "shared")


def layer_stages(name: str) -> list[Stage]:
    recipe = recipe_named(name)
    return [stage for stage in recipe.stages if "layers" in stage.weights.rendered]


@pytest.mark.parametrize("name", ["polarguide", "polarguide-stokes"])
def test_ours_hold_normals_while_the_density_control_runs(name: str) -> None:
    held = [stage.hold_normals for stage in layer_stages(name)]
    assert held == [stage.densify for stage in layer_stages(name)]
    assert held[0]
    assert not held[-1]
    assert not any(stage.hold_normals for stage in layer_stages(f"{name}:layers-turn-normals"))
    assert all(stage.hold_normals for stage in layer_stages(f"{name}:layers-hold-normals"))


@pytest.mark.parametrize("name", ["polarguide", "polarguide-stokes"])
def test_terms_on_normals_move_nothing_behind_the_subject(name: str) -> None:
    assert all(stage.behind for stage in layer_stages(name))
    assert all(stage.behind for stage in layer_stages(f"{name}:unpolarized"))
    assert not any(stage.behind for stage in layer_stages(f"{name}:normals-move-all"))
