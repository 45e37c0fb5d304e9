"""The state before the first step, and the random draws of a training."""

from __future__ import annotations

import torch

from polarguide.capture import Scene
from polarguide.gaussians.densify import DensityStatistics
from polarguide.gaussians.initialise import SH_C0, initial_rows
from polarguide.gaussians.rows import GaussianRows
from polarguide.shading.display import srgb_decode
from polarguide.training.settings import TrainSettings
from polarguide.training.stages import Recipe
from polarguide.training.state import Environment, TrainingState


def seeded(*numbers: int) -> torch.Generator:
    """A generator that depends on all the numbers: draws do not depend on what was drawn before."""
    value = 0
    for number in numbers:
        value = (value * 1_000_003 + number + 1) % (2**63 - 1)
    return torch.Generator().manual_seed(value)


def first_state(
    scene: Scene, recipe: Recipe, settings: TrainSettings, device: torch.device | str = "cpu"
) -> TrainingState:
    """The state before the first step; drawn on the CPU, so that every device begins with the same."""
    colours = srgb_decode(scene.point_colours.float() / 255)
    centres = torch.stack([view.camera.centre for view in scene.train_views])
    tensors = initial_rows(scene.points, colours, centres, recipe.initialisation, seed=settings.seed)
    count = tensors["means"].shape[0]
    environment = None
    if recipe.oriented:
        tensors["outward"] = torch.zeros(count, 3)
    if recipe.directional is not None:
        generator = seeded(settings.seed, 5)
        tensors.update(recipe.directional.first_rows(tensors["sh_dc"] * SH_C0 + 0.5, generator))
        light = recipe.directional.first_light_values(
            recipe.environment_resolution, recipe.environment_spread, generator
        )
        light = {name: t.to(device) for name, t in light.items()}
        environment = Environment(light, recipe.environment_rates)
    elif recipe.reflects:
        logit = torch.logit(torch.tensor(recipe.first_strength))
        tensors["strength_logits"] = logit.expand(count).clone()
        if recipe.local:
            tensors["local_dc"] = torch.zeros(count, 3)
            tensors["local_rest"] = torch.zeros(count, 15, 3)
        size = (6, recipe.environment_resolution, recipe.environment_resolution, 3)
        uniform = torch.rand(size, generator=seeded(settings.seed, 1)) * 2 - 1
        texels = (uniform * recipe.environment_spread).to(device)
        environment = Environment({"texels": texels}, recipe.environment_rates)
    rows = GaussianRows({name: t.to(device) for name, t in tensors.items()}, recipe.rates)
    statistics = DensityStatistics(count, settings.views_per_step, rows["means"].device)
    return TrainingState(0, rows, environment, statistics)
