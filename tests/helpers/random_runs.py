"""Untrained states of every kind of shading, for tests: random Gaussians about the origin, and cameras around them."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from polarguide.gaussians.gaussians import Gaussians
from polarguide.geometry.camera import Camera, look_at
from polarguide.methods import RECIPES
from polarguide.shading.model import ShadingModel
from polarguide.training.context import Environment, TrainingState

KINDS = {"3dgs": "plain", "3dgs-dr": "reflection", "polarguide-stokes": "local", "ref-gs": "directional"}
"""A recipe for each kind of shading."""


def random_state(name: str, count: int = 300, *, metal: bool = False) -> tuple[TrainingState, ShadingModel]:
    """A state as the recipe's training would leave, and its shading; with ``metal``, of which a third are metals."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    recipe = RECIPES[name]
    gaussians = {
        "means": 0.7 * normal(count, 3),
        "quaternions": normal(count, 4),
        "log_scales": 0.5 * normal(count, 3) - 2,
        "opacity_logits": 2 * normal(count),
        "sh_dc": 0.5 * normal(count, 3),
        "sh_rest": 0.1 * normal(count, 15, 3),
    }
    light: dict[str, Tensor] = {}
    if "specular" in recipe.shading.layers:
        model = replace(recipe.shading, environment_resolution=8, environment_spread=1.5)  # type: ignore[call-arg]
        near = torch.zeros(count, dtype=torch.bool)
        first, light = model.initialize(0.5 + 0.28 * gaussians["sh_dc"], near, generator)
        gaussians |= first
    for key, spread in {"strength_logits": 1.0, "local_dc": 0.3, "local_rest": 0.1}.items():
        if key in gaussians:
            gaussians[key] = spread * normal(*gaussians[key].shape)
    if metal:
        gaussians["metalness"][::3] = 1
        gaussians["reflectance_logits"], gaussians["roughness_logits"] = normal(count, 3), normal(count)
    if "surface" in gaussians:
        gaussians["surface"][::5] = 0
        gaussians["sh_rest"][::5] = 0  # for which a page has no room
    if recipe.oriented:
        gaussians["outward"] = normal(count, 3)
        gaussians["outward"][::5] = 0  # not seen by any view
    environment = Environment(light, recipe.light_rates) if light else None
    trained = Gaussians(gaussians, recipe.learning_rates)
    state = TrainingState(0, trained, environment)
    state.extra = {name: torch.zeros(count) for name in ("statistics.gradient", "statistics.seen")}
    return state, recipe.shading


def ring(count: int = 6, distance: float = 4.0, width: int = 64, height: int = 48) -> dict[str, Camera]:
    """Cameras around the origin, a little above it; the world's up is -y, as structure from motion tends to have it."""
    eye = torch.eye(3, dtype=torch.float64)
    lens = Camera(width, height, 1.1 * width, 1.1 * width, 0.48 * width, 0.53 * height, eye, eye[0])
    cameras = {}
    for k in range(count):
        angle = 2 * math.pi * k / count
        place = [distance * math.cos(angle), -0.3 * distance, distance * math.sin(angle)]
        rotation, translation = look_at(place, (0.0, 0.0, 0.0), -eye[1])
        cameras[f"v{k}"] = replace(lens, rotation=rotation, translation=translation)
    return cameras
