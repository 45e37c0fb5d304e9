"""The loss of one step: each term a small function, summed by a stage's weights."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from polarguide.camera import Camera
from polarguide.errors import PolarguideError
from polarguide.shading.model import ShadingModel
from polarguide.shading.result import RenderResult
from polarguide.training.photometric import photometric_loss
from polarguide.training.priors import ViewPriors
from polarguide.training.recipe import Weights
from polarguide.vectors import dot, unit


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Unit normals of a depth picture by central differences, facing the camera.

    Args:
        depth: [H, W] camera depth, positive.
        camera: of the picture.

    Returns:
        [H, W, 3] in world axes, differentiable; zero on the border and where three points lie on a line.
    """
    rays = camera.rays(dtype=depth.dtype, device=depth.device)
    points = rays / rays[..., 2:] * depth[..., None]
    # In units of the depth, so that the length that ``unit`` takes for zero means the same near and far.
    scale = 1 / depth.detach().clamp(min=1e-6)[1:-1, 1:-1, None]
    across = (points[1:-1, 2:] - points[1:-1, :-2]) * scale
    down = (points[2:, 1:-1] - points[:-2, 1:-1]) * scale
    return pad(camera.to_world(unit(torch.linalg.cross(down, across))), (0, 0, 1, 1, 1, 1))


def consistency_loss(result: RenderResult, camera: Camera, weight: Tensor | None = None) -> Tensor:
    """Mean of ``alpha - n . n_depth``: 0 where blended normals agree with each other and with the depth.

    Args:
        result: with the blended normal ``n`` (unit normals times weights that add up to alpha) and the depth.
        camera: of the view.
        weight: [H, W] where it counts; None: everywhere.
    """
    assert result.normal is not None
    assert result.depth is not None
    cosine = dot(result.normal, depth_normals(result.depth, camera))
    distance = result.alpha.detach() - cosine
    return (distance if weight is None else weight * distance)[1:-1, 1:-1].mean()


def normal_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Mean of 1 - cos(normal, target) over the weighted pixels (the normal term of Shan et al. 2026).

    Args:
        normal: [H, W, 3] blended normals, world axes, any length.
    """
    cosine = dot(unit(normal, 1e-2), priors.normal)
    return ((1 - cosine) * priors.weight).sum() / priors.weight.sum().clamp(min=1)


def azimuth_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Mean distance of the normal from the plane of incidence that the AoLP gives, |n . e|.

    Unlike the zenith of a pure-lobe inversion, the plane does not depend on the refractive index or on how lobes mix.
    """
    distance = dot(unit(normal, 1e-2), priors.plane).abs()
    return (distance * priors.weight).sum() / priors.weight.sum().clamp(min=1)


def chromatic_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Mean of 1 - cos(normal, normal from color differences) over the pixels that these decide.

    Args:
        normal: [H, W, 3] blended normals, world axes, any length.
    """
    cosine = dot(unit(normal, 1e-2), priors.chromatic)
    return ((1 - cosine) * priors.chromatic_weight).sum() / priors.chromatic_weight.sum().clamp(min=1)


def stokes_loss(result: RenderResult, priors: ViewPriors, shading: ShadingModel) -> Tensor:
    """Mean distance of the predicted S1 and S2 from the measured ones, over the square root of S0.

    The shading model predicts from the rendered layers and the rendered normal, so that one explanation of
    geometry and layers has to fit the polarization of all views. The variance of S1 and S2 grows with S0 where light
    itself is the noise; the root evens that out.

    Args:
        result: with both layers and the normal. shading: of the recipe, for the run's refractive index.
    """
    predicted = shading.predicted_stokes(result, priors.camera)
    distance = (predicted[1:] - priors.stokes[1:]).abs().mean(dim=(0, -1))
    scale = (priors.stokes[0].mean(dim=-1) + 0.01).rsqrt()
    return (priors.reliable * scale * distance).mean()


def flatness_loss(log_scales: Tensor, radii: Tensor, extent: float) -> Tensor:
    """Mean shortest scale of the visible Gaussians in percent of the scene's extent.

    Args:
        log_scales: [N, 3]. radii: [N], 0 where not visible. extent: of the scene.
    """
    visible = (radii > 0).to(log_scales)
    shortest = log_scales.amin(dim=1).exp()
    return 100 / extent * (shortest * visible).sum() / visible.sum().clamp(min=1)


def step_loss(
    result: RenderResult,
    shown: Tensor,
    valid: Tensor | None,
    weights: Weights,
    priors: ViewPriors | None,
    *,
    ssim_weight: float,
    shading: ShadingModel,
    log_scales: Tensor,
    extent: float,
    camera: Camera | None = None,
) -> tuple[Tensor, Tensor]:
    """The weighted sum of a stage's terms, and its photometric term alone (for the display).

    Args:
        result: the rendered layers.
        shown: [H, W, 3] the photograph as shown (sRGB).
        valid: [H, W] 1 where the photograph counts; None: everywhere.
        weights: of the stage.
        priors: of the view; needed where a weight asks for them.
        ssim_weight: lambda of the image terms.
        shading: of the stage, for the run's refractive index.
        log_scales: [N, 3] of the Gaussians. extent: of the scene.
        camera: of the view; needed where a weight asks for the normals of the depth.
    """
    photometric = photometric_loss(result.final, shown, valid, ssim_weight)
    total = weights.photometric * photometric
    if priors is not None:
        total = total + _prior_terms(result, weights, priors, ssim_weight)
        if weights.stokes and shading.reflects:
            total = total + weights.stokes * stokes_loss(result, priors, shading)
    if weights.flatness and result.radii is not None:
        total = total + weights.flatness * flatness_loss(log_scales, result.radii, extent)
    if weights.consistency and camera is not None:
        total = total + weights.consistency * consistency_loss(
            result, camera, None if priors is None else priors.weight
        )
    if total.device.type == "cpu":
        refuse_diverged(total.detach())
    return total, photometric


def refuse_diverged(total: Tensor) -> None:
    """Raise PolarguideError unless all of ``total`` is finite.

    On a GPU this waits for the device, so the loop asks for many steps at once.
    """
    if not bool(torch.isfinite(total).all()):
        raise PolarguideError(
            "training",
            expected="a finite loss",
            found=str(float(total.sum())),
            remedy="Lower the learning rates, or resume from an earlier checkpoint.",
        )


def _prior_terms(result: RenderResult, weights: Weights, priors: ViewPriors, ssim_weight: float) -> Tensor:
    """The weighted sum of the terms that compare with a view's priors."""
    total = result.final.new_zeros(())
    for weight, layer, target in (
        (weights.specular, result.specular, priors.specular),
        (weights.diffuse, result.diffuse, priors.diffuse),
    ):
        if weight and layer is not None:
            total = total + weight * photometric_loss(layer, target, priors.separated, ssim_weight)
    for weight, loss in (
        (weights.normal, normal_loss),
        (weights.azimuth, azimuth_loss),
        (weights.chromatic, chromatic_loss),
    ):
        if weight and result.normal is not None:
            total = total + weight * loss(result.normal, priors)
    return total
