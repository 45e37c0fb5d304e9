"""Train 3dgs with a normal loss on exported normal maps, as another trainer would.

The folder is an export with ``--format normals --layout brush``. For the rendered normal n and the normal m of the map,
both unit vectors, the loss is the mean of ``|n - m|_1 + 1 - n . m`` over the decided pixels, in all steps. It follows
the loss of Brush, whose guide has the weight 0.05. Brush does not normalize n and begins after a sixth of the steps.

    polarguide export RUN --format normals --layout brush --out FOLDER
    python benchmarks/accuracy/normal_maps.py SCENE FOLDER/brush OUT [--weight 0.05] [--downscale 2] [--steps 1500]

Compare the run with one without the loss:

    polarguide train SCENE --recipe 3dgs --downscale 2 --steps 1500 --out PLAIN
    polarguide eval OUT
    polarguide eval PLAIN
    python benchmarks/accuracy/paired_runs.py --runs OUT... --less PLAIN...

The photographs are read from the scene, so that both trainings have the same held-out views.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

import polarguide
from polarguide.capture import Scene
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.methods import recipe_named
from polarguide.training.losses import Weights, term
from polarguide.training.recipe import Recipe
from polarguide.training.targets import Step

Maps = dict[tuple[float, ...], tuple[Tensor, Tensor]]
"""Normals [H, W, 3] in camera axes (right, down, forward) and weights [H, W], by the translation of the camera."""


def key_of(camera: Camera) -> tuple[float, ...]:
    """Return the translation of a camera, which identifies its view."""
    return tuple(camera.translation.tolist())


def read_maps(folder: Path, scene: Scene) -> Maps:
    """Read the normal maps of all training views. Their axes are right, up and toward the viewer."""
    maps = {}
    for view in scene.train_views:
        pixels = cv2.imread(str(folder / "normals" / f"{view.name}.png"), cv2.IMREAD_UNCHANGED)
        codes = torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA).astype(np.float32)) / 255
        normals = (2 * codes[..., :3] - 1) * torch.tensor([1.0, -1.0, -1.0])
        maps[key_of(view.camera)] = (unit(normals), codes[..., 3])
    return maps


def recipe_with(maps: Maps, weight: float) -> Recipe:
    """Return the recipe 3dgs with the normal loss in each stage."""

    def map_term(step: Step, weights: MapWeights) -> Tensor | None:
        if not weights.maps:
            return None
        normals, decided = maps[key_of(step.targets.camera)]
        rendered = unit(step.targets.camera.to_camera(step.result.normal), 1e-2)
        distance = (rendered - normals).abs().sum(dim=-1) + 1 - dot(rendered, normals)
        return weights.maps * (decided * distance).sum() / decided.sum().clamp(min=1)

    @dataclass(frozen=True)
    class MapWeights(Weights):
        """Weights of all loss terms, and of the normal maps."""

        maps: float = term(rendered=("normal",))

        def own_terms(self) -> Sequence[Callable[[Step, MapWeights], Tensor | None]]:
            return (map_term,)

    base = recipe_named("3dgs")
    stages = [replace(s, weights=MapWeights(**vars(s.weights), maps=weight)) for s in base.stages]
    return replace(base, stages=tuple(stages))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene")
    parser.add_argument("folder", type=Path)
    parser.add_argument("out")
    parser.add_argument("--weight", type=float, default=0.05)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    scene = polarguide.load_scene(options.scene, downscale=options.downscale)
    recipe = recipe_with(read_maps(options.folder, scene), options.weight)
    settings = polarguide.TrainSettings(steps=options.steps, seed=options.seed)
    polarguide.train(scene, options.out, recipe=recipe, settings=settings)


if __name__ == "__main__":
    main()
