"""The controls without polarization read none: other S1 and S2 of the same S0 change no bit of what they train."""

from dataclasses import replace

import pytest
import torch
from trainings import different, trained

from polarguide import optics
from polarguide.capture import Scene, View
from polarguide.methods import RECIPES, recipe_named
from polarguide_bench.recipes import ablations_of

STEPS = 30
CONTROLS = [r.name for base in (*RECIPES, "polgs") for r in ablations_of(base) if ":unpolarized" in r.name]


def repolarized(view: View) -> View:
    """S1 and S2 exchanged, and negated in every other column: pictures of the four angles change places."""
    order = torch.tensor([1, 0, 3, 2])  # 0 with 45 and 90 with 135 degrees
    codes = view.codes[order]
    codes[:, :, ::2] = codes[:, :, ::2][torch.tensor([2, 3, 0, 1])]
    return replace(view, pictures=codes)


@pytest.fixture(scope="module")
def other_scene(tiny_scene: Scene) -> Scene:
    return replace(tiny_scene, views=tuple(repolarized(view) for view in tiny_scene.views))


def changed(name: str, *scenes: Scene) -> list[str]:
    """Names of the tensors in which trainings on two scenes differ."""
    recipe = recipe_named(name)
    # Density control and huge Gaussians within the thirty steps, too.
    density = replace(recipe.densification, every=5, gradient=1e-5, large_minimum=1)
    recipe = replace(recipe, densification=density)
    return different(*(trained(scene, recipe, STEPS) for scene in scenes))


def test_the_other_scene_differs_in_s1_and_s2_alone(tiny_scene: Scene, other_scene: Scene) -> None:
    for old, new in zip(tiny_scene.views, other_scene.views, strict=True):
        assert torch.equal(old.photograph(), new.photograph())
        before, after = optics.stokes(old.intensities()), optics.stokes(new.intensities())
        torch.testing.assert_close(after[0], before[0])
        sign = torch.ones(before.shape[2])
        sign[::2] = -1
        torch.testing.assert_close(after[1:], sign[:, None] * before[1:].flip(0), atol=1e-4, rtol=0)
        assert float((after[1:] - before[1:]).abs().max()) > 0.1


def test_every_recipe_of_ours_has_its_control() -> None:
    assert set(CONTROLS) == {
        "polarguide-paper:unpolarized",
        "polarguide:unpolarized",
        "polarguide:unpolarized-without-consistency",
        "polarguide-stokes:unpolarized",
        "polarguide-stokes:unpolarized-without-consistency",
        "polgs:unpolarized",
    }


@pytest.mark.parametrize("name", [*CONTROLS, "3dgs-dr", "ref-gs"])
def test_no_bit_depends_on_polarization(tiny_scene: Scene, other_scene: Scene, name: str) -> None:
    assert changed(name, tiny_scene, other_scene) == []


@pytest.mark.parametrize(
    "name", ["polarguide-paper", "polarguide-paper:kind", "polarguide", "polarguide-stokes"]
)
def test_of_what_polarization_guides_bits_do(tiny_scene: Scene, other_scene: Scene, name: str) -> None:
    names = changed(name, tiny_scene, other_scene)
    assert {"gaussians.means", "gaussians.quaternions", "environment.texels"} <= {*names}


def test_consistency_counts_everywhere_in_the_control() -> None:
    assert all(
        not stage.weights.priors and stage.weights.consistency == base.weights.consistency
        for stage, base in zip(
            recipe_named("polarguide-stokes:unpolarized").stages,
            RECIPES["polarguide-stokes"].stages,
            strict=True,
        )
    )
