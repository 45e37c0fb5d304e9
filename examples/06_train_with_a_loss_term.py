"""Train with a loss term of your own: normals of neighboring pixels agree.

python examples/06_train_with_a_loss_term.py src/polarguide/data/demo runs/smooth 400
"""

import sys
from dataclasses import dataclass, replace

import polarguide
from polarguide.methods import recipe_named
from polarguide.training.losses import Weights, term


def roughness_of(normal):
    """Return the mean difference of neighboring normals [H, W, 3]."""
    across = (normal[:, 1:] - normal[:, :-1]).abs().mean()
    down = (normal[1:] - normal[:-1]).abs().mean()
    return across + down


def smooth_term(step, weights):
    """Return the weighted loss [] of a step, or None without a weight."""
    return weights.smooth * roughness_of(step.result.normal) if weights.smooth else None


@dataclass(frozen=True)
class SmoothWeights(Weights):
    """Weights of all loss terms, and of the new one."""

    smooth: float = term(rendered=("normal",))  # the term reads rendered normals

    def own_terms(self):
        return (smooth_term,)


def with_smooth_normals(recipe, weight):
    """Return the recipe with the new term in each stage."""
    stages = [replace(s, weights=SmoothWeights(**vars(s.weights), smooth=weight)) for s in recipe.stages]
    return replace(recipe, name="smooth", stages=tuple(stages))


if __name__ == "__main__":
    scene = polarguide.load_scene(sys.argv[1], downscale=4)
    settings = polarguide.TrainSettings(steps=int(sys.argv[3]))
    base = recipe_named("polarguide-stokes")
    for recipe in (base, with_smooth_normals(base, 0.1)):
        run = polarguide.train(scene, f"{sys.argv[2]}-{recipe.name}", recipe=recipe, settings=settings)
        normal = run.render(scene.test_names[0], layers=["normal"])["normal"]
        print(f"{recipe.name}: difference of neighboring normals {roughness_of(normal):.4f}")
