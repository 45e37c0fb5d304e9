"""Changes of Gaussians between steps: resets, normal propagation, outward directions, pixel counts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide.capture import View
from polarguide.geometry.camera import Camera, seen_at
from polarguide.geometry.vectors import unit
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import RenderRequest, render, splats
from polarguide.shading.model import Parameters, ShadingModel
from polarguide.training.recipe import Propagation
from polarguide.training.state import TrainingState


def _logit(value: float) -> float:
    return float(torch.logit(torch.tensor(value, dtype=torch.float64)))


@torch.no_grad()
def reset_opacity(state: TrainingState, shading: ShadingModel, most: float) -> None:
    """Lower opacities to at most ``most``, so that unneeded Gaussians stay transparent (Kerbl et al. 2023).

    Parameters of the shading model rise to their minimum after a reset, if they have one.
    """
    gaussians = state.gaussians
    gaussians.overwrite("opacity_logits", gaussians["opacity_logits"].clamp(max=_logit(most)))
    for name, parameter in shading.parameters.items():
        if parameter.reset_minimum is not None:
            gaussians.overwrite(name, gaussians[name].clamp(min=parameter.reset_minimum))


@torch.no_grad()
def propagate_normals(
    state: TrainingState,
    shading: ShadingModel,
    settings: Propagation,
    generator: torch.Generator,
    steps: int,
) -> None:
    """Let Gaussians with a right normal take over their neighborhood (Ye et al. 2024, Sec. 3.3).

    Opacities rise. Matte Gaussians get noise on their color, which hides the light that they explain by color alone.
    Glossy Gaussians grow along their surface.
    """
    gaussians = state.gaussians
    strength = shading.strength(gaussians)
    gaussians.overwrite("opacity_logits", gaussians["opacity_logits"].clamp(min=_logit(settings.opacity)))
    # Drawn on the CPU: the noise is the same on every device.
    noise = (torch.rand(gaussians["sh_dc"].shape, generator=generator) * 2 - 1) * settings.color_noise
    noise = noise.to(gaussians["sh_dc"].device)
    matte = (strength <= settings.matte)[:, None]
    # As in the release, the noise is added to the SH coefficient itself.
    gaussians.overwrite("sh_dc", gaussians["sh_dc"] + torch.where(matte, noise, torch.zeros_like(noise)))
    scales = gaussians["log_scales"]
    longer = torch.ones_like(scales).scatter(1, scales.argmin(dim=1, keepdim=True), 0.0)
    grow = (strength >= settings.glossy)[:, None] * longer * torch.log(torch.tensor(settings.widen))
    gaussians.overwrite("log_scales", scales + grow)
    state.opacity_frozen_until = state.step + min(settings.rest, steps // settings.rest_part)


DEPTH_SLACK = 0.02
"""Largest distance of a visible Gaussian behind the rendered surface, relative to its depth."""
LEAST_PIXELS = 0.05
"""Least sum of the blending weights of a Gaussian that contributes to a picture."""
DEPTH_ALONE = RenderRequest(sh_degree=0, normals=False, depth=True)


@torch.no_grad()
def outward_directions(gaussians: Parameters, views: Iterable[View], rasterize: Rasterize) -> Tensor:
    """Return the sum of the unit directions to the cameras that see each Gaussian.

    A camera sees a Gaussian if its center is inside the picture and not behind the rendered depth.

    Args:
        gaussians: the Gaussians.
        views: views with the cameras.
        rasterize: rasterizer of the backend.

    Returns:
        [N, 3]; zero for Gaussians that no camera sees.
    """
    means = gaussians["means"]
    total = torch.zeros_like(means)
    for view in views:
        camera = view.camera
        depth = render(gaussians, camera, rasterize, DEPTH_ALONE).depth
        center = camera.pose(means.dtype, means.device).center
        pixel, z, inside = seen_at(means - center, camera)
        visible = inside & (z < depth[pixel] * (1 + DEPTH_SLACK))
        total += visible[:, None] * unit(center - means)
    return total


class PixelCounts(NamedTuple):
    """Pixels of each Gaussian in training pictures.

    Attributes:
        views: [N] float32, number of pictures in which the sum of its blending weights is at least ``LEAST_PIXELS``.
        most: [N] largest sum of its blending weights in a picture, in pixels.
    """

    views: Tensor
    most: Tensor


def touched_pixels(gaussians: Parameters, cameras: Iterable[Camera], rasterize: Rasterize) -> PixelCounts:
    """Count the pixels of each Gaussian in pictures.

    Args:
        gaussians: the Gaussians.
        cameras: cameras of the pictures.
        rasterize: rasterizer of the backend.
    """
    splatted = splats(gaussians)
    views = torch.zeros(len(splatted.means), device=splatted.means.device)
    most = torch.zeros_like(views)
    for camera in cameras:
        # The gradient of the summed weights with respect to a feature is the sum of its Gaussian's weights.
        with torch.enable_grad():
            features = torch.ones_like(splatted.features).requires_grad_()
            fixed = type(splatted)(*(tensor.detach() for tensor in splatted))
            total = rasterize(fixed._replace(features=features), camera).features.sum()
            pixels = torch.autograd.grad(total, features)[0][:, 0]
        views += (pixels >= LEAST_PIXELS).float()
        most = torch.maximum(most, pixels)
    return PixelCounts(views, most)
