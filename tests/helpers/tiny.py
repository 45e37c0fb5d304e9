"""A scene small enough to train on in a test: smooth polarized pictures of Gaussians, seen from a circle."""

import dataclasses
import math
from pathlib import Path

import torch
from reference_rasterizer import rasterize_reference
from torch import Tensor

from polarguide.capture import Scene, View
from polarguide.geometry.camera import Camera, look_at
from polarguide.methods.baselines import SHADING_3DGS_DR
from polarguide.methods.polarguide import RECIPE_POLARGUIDE
from polarguide.raster import Splats
from polarguide.training.recipe import Recipe, Repeat, Stage, Weights
from polarguide_bench.recipes import release_rates

WIDTH, HEIGHT, VIEWS, GAUSSIANS = 24, 20, 6, 40
STEPS = 60


def circling(angle: float) -> Camera:
    """A camera at distance 4 from the origin, somewhat above it, that looks at it."""
    center = (4 * math.cos(angle), -1.2, 4 * math.sin(angle))
    pose = look_at(center, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0))
    return Camera(WIDTH, HEIGHT, 28.0, 28.0, WIDTH / 2, HEIGHT / 2, *pose)


def polarized_codes(picture: Tensor, alpha: Tensor) -> Tensor:
    """Codes [4, H, W, 3] of a picture [H, W, 5]: color, and two channels that become S1 / S0 and S2 / S0."""
    background = torch.tensor([0.2, 0.25, 0.3])
    half = (picture[..., :3] + (1 - alpha[..., None]) * background).clamp(0.02, 0.9)
    q, u = picture[..., 3:4], picture[..., 4:5]
    doubled = torch.deg2rad(2 * torch.tensor([0.0, 45.0, 90.0, 135.0]))[:, None, None, None]
    intensities = half * (1 + q * torch.cos(doubled) + u * torch.sin(doubled))
    return (intensities.clamp(0, 0.98) * 65535).round().to(torch.uint16)


def make_scene() -> Scene:
    """Polarized pictures of random Gaussians."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    means = torch.randn(GAUSSIANS, 3, generator=generator) * 0.5
    features = torch.cat((uniform(GAUSSIANS, 3), 0.8 * (uniform(GAUSSIANS, 2) - 0.5)), dim=1)
    splats = Splats(
        means,
        uniform(GAUSSIANS, 4) - 0.5,
        0.15 + 0.4 * uniform(GAUSSIANS, 3),
        0.5 + 0.4 * uniform(GAUSSIANS),
        features,
    )
    nowhere = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    views = []
    for index in range(VIEWS):
        camera = circling(2 * math.pi * index / VIEWS)
        picture = rasterize_reference(splats, camera)
        codes = polarized_codes(picture.features, picture.alpha)
        views.append(View(f"v{index}", camera, codes, nowhere, nowhere))
    return Scene(
        root=Path("tiny"),
        name="tiny",
        views=tuple(views),
        test_names=("v0",),
        points=means,
        point_colors=(features[:, :3] * 255).to(torch.uint8),
        refractive_index=1.5,
        downscale=1,
        transfer="linear",
        digest="tiny",
        warnings=(),
    )


def make_busy_recipe() -> Recipe:
    """A recipe in which, in 60 steps, everything that can happen happens before step 25 and after it."""
    guided = Weights(specular=0.5, diffuse=0.2, normal=0.1, azimuth=0.3)
    repeats = (
        Repeat("reset_opacity", fraction=13 / STEPS),
        Repeat("propagate_normals", fraction=9 / STEPS),
        Repeat("refresh_priors", fraction=7 / STEPS),
    )
    recipe = release_rates()(RECIPE_POLARGUIDE)  # slow: rounding stays small beside a step
    return dataclasses.replace(
        recipe,
        name="busy",
        stages=(
            Stage("plain", 0.1, reflection=False, densify=True),
            Stage("all", 0.7, True, guided, densify=True, repeats=repeats, on_enter=("refresh_priors",)),
            Stage("final", 0.2, True, Weights(azimuth=0.3), on_enter=("refresh_priors",)),
        ),
        sh_fractions=(0.2, 0.4, 0.6),
        shading=dataclasses.replace(SHADING_3DGS_DR, environment_resolution=16),
        initialization=dataclasses.replace(recipe.initialization, shell=50),
        densification=dataclasses.replace(
            recipe.densification,
            every=8,
            gradient=1e-5,
            dense_share=0.02,
            minimum_opacity=0.006,
            pixels_each=100.0,
            maximum_scale_share=0.3,
            large_from=18 / STEPS,
            large_minimum=1,
        ),
    )
