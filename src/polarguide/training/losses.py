"""The loss of one step: each term a small function, summed by a stage's weights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from polarguide import _native
from polarguide.camera import Camera
from polarguide.errors import PolarguideError
from polarguide.native import fits
from polarguide.shading.model import ShadingModel
from polarguide.shading.result import RenderResult
from polarguide.training.native_terms import (
    S1_AND_S2,
    Consistency,
    Directions,
    Polarization,
    Terms,
    pixel_terms,
)
from polarguide.training.partial import PartialView, partial_terms
from polarguide.training.photometric import photometric_loss, photometric_terms
from polarguide.training.priors import ViewPriors
from polarguide.training.recipe import Weights
from polarguide.vectors import dot, unit

# Weight of ``coverage_loss``.
COVERAGE = 0.1


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

    A picture without an inner pixel has no depth normals, and no loss.

    Args:
        result: with the blended normal ``n`` (unit normals times weights that add up to alpha) and the depth.
        camera: of the view.
        weight: [H, W] where it counts; None: everywhere.
    """
    assert result.normal is not None
    assert result.depth is not None
    if min(result.alpha.shape) < 3:
        return result.alpha.new_zeros(())
    cosine = dot(result.normal, depth_normals(result.depth, camera))
    distance = result.alpha.detach() - cosine
    return (distance if weight is None else weight * distance)[1:-1, 1:-1].mean()


def nearest_target(normal: Tensor, priors: ViewPriors) -> Tensor:
    """What the normal term compares with, [H, W, 3]: of a view with candidates the one nearest to the normals just
    rendered, otherwise what the frozen Gaussians have chosen.

    Args:
        normal: [H, W, 3] blended normals, world axes, any length; gets no gradient.
    """
    if priors.candidates is None:
        return priors.normal
    nearest = dot(normal.detach()[..., None, :], priors.candidates).argmax(dim=-1)
    return torch.take_along_dim(priors.candidates, nearest[..., None, None], dim=-2).squeeze(-2)


def normal_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Mean of 1 - cos(normal, target) over the weighted pixels (the normal term of Shan et al. 2026).

    The target is ``nearest_target``.

    Args:
        normal: [H, W, 3] blended normals, world axes, any length.
    """
    cosine = dot(unit(normal, 1e-2), nearest_target(normal, priors))
    return ((1 - cosine) * priors.weight).sum() / priors.total


def azimuth_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Mean distance of the normal from the plane of incidence that the AoLP gives, |n . e|.

    Unlike the zenith of a pure-lobe inversion, the plane does not depend on the refractive index or on how lobes mix.
    """
    distance = dot(unit(normal, 1e-2), priors.plane).abs()
    return (distance * priors.weight).sum() / priors.total


def chromatic_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Mean of 1 - cos(normal, normal from color differences) over the pixels that these decide.

    Args:
        normal: [H, W, 3] blended normals, world axes, any length.
    """
    cosine = dot(unit(normal, 1e-2), priors.chromatic)
    return ((1 - cosine) * priors.chromatic_weight).sum() / priors.chromatic_total


def stokes_loss(result: RenderResult, priors: ViewPriors, shading: ShadingModel) -> Tensor:
    """Mean distance of the predicted S1 and S2 from the measured ones, over the square root of S0.

    The shading model predicts from the rendered layers and the rendered normal, so that one explanation of
    geometry and layers has to fit the polarization of all views. See ``ViewPriors.stokes_weight`` for the root.

    Args:
        result: with both layers and the normal. shading: of the recipe, for the run's refractive index.
    """
    predicted = shading.predicted_stokes(result, priors.camera)
    distance = (predicted[1:] - priors.stokes[1:]).abs().mean(dim=(0, -1))
    return (priors.stokes_weight * distance).mean()


def flatness_loss_reference(log_scales: Tensor, radii: Tensor, extent: float) -> Tensor:
    """The reference implementation of ``flatness_loss``: plain torch, any dtype and device."""
    visible = (radii > 0).to(log_scales)
    total = (log_scales.min(dim=1).values.exp() * visible).sum()
    return 100 / extent * total / visible.sum().clamp(min=1)


class _Flatness(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, radii: Tensor, extent: float) -> Tensor:
        kept = log_scales.detach().contiguous(), radii.detach().contiguous()
        total, count = _native.shortest_sum(*kept)
        ctx.save_for_backward(*kept)
        ctx.factor = 100 / extent / max(count, 1.0)
        return log_scales.new_tensor(ctx.factor * total)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        log_scales, radii = ctx.saved_tensors
        to = torch.empty_like(log_scales)
        _native.shortest_gradient(log_scales, radii, ctx.factor * float(grad), to)
        return to, None, None


def flatness_loss(log_scales: Tensor, radii: Tensor, extent: float) -> Tensor:
    """Mean shortest scale of the visible Gaussians in percent of the scene's extent.

    On the CPU in float32 it is a native pass; ``flatness_loss_reference`` is the reference implementation.

    Args:
        log_scales: [N, 3]. radii: [N], 0 where not visible. extent: of the scene.
    """
    if not fits(log_scales, radii):
        return flatness_loss_reference(log_scales, radii, extent)
    loss: Tensor = _Flatness.apply(log_scales, radii, extent)
    return loss


def coverage_loss(alpha: Tensor, empty: Tensor) -> Tensor:
    """Mean alpha of the pixels that show nothing.

    Args:
        alpha: [H, W]. empty: [H, W] 1 where the picture shows nothing.
    """
    return (alpha * empty).sum() / empty.sum().clamp(min=1)


class StepLoss(NamedTuple):
    """What a step minimizes, and what it tells about itself.

    Attributes:
        total: the weighted sum of a stage's terms. photometric: that term alone, for the display.
        error: mean squared difference of picture and photograph as shown, where the photograph counts; no gradient.
    """

    total: Tensor
    photometric: Tensor
    error: Tensor


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
    empty: Tensor | None = None,
    partial: PartialView | None = None,
) -> StepLoss:
    """The weighted sum of a stage's terms, and how far the picture is from the photograph.

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
        empty: [H, W] 1 where the view shows nothing; None: where that is not known.
        partial: what a view measured that does not determine the Stokes vector, in place of ``shown``.
    """
    if result.detached_layers is not None:
        specular, diffuse, metal = result.detached_layers
        result = replace(result, specular=specular, diffuse=diffuse, metal=metal)
    if partial is None:
        picture = photometric_terms(result.final, shown, valid, ssim_weight)
        total = weights.photometric * picture.loss
    else:
        assert camera is not None
        total, picture = partial_terms(
            result,
            partial,
            weights,
            valid=valid,
            ssim_weight=ssim_weight,
            shading=shading,
            camera=camera,
        )
    if priors is not None:
        total = total + _layer_terms(result, weights, priors, ssim_weight)
    if weights.flatness and result.radii is not None:
        total = total + weights.flatness * flatness_loss(log_scales, result.radii, extent)
    total = total + normal_terms(result, weights, priors, camera, shading)
    if empty is not None:
        total = total + COVERAGE * coverage_loss(result.alpha, empty)
    if total.device.type == "cpu":
        refuse_diverged(total.detach())
    return StepLoss(total, *picture)


def refuse_diverged(total: Tensor) -> None:
    """Raise PolarguideError unless all of ``total`` is finite.

    On a GPU this waits for the device, so the loop asks for many steps at once.
    """
    if not bool(torch.isfinite(total).all()):
        raise PolarguideError(
            "training",
            expected="a finite loss",
            found=str(float(total.sum())),
            remedy="Look at the pictures and poses (polarguide inspect); with a recipe of yours, lower its rates.",
        )


def _layer_terms(result: RenderResult, weights: Weights, priors: ViewPriors, ssim_weight: float) -> Tensor:
    """The weighted sum of the terms that compare layers with the separated pictures."""
    total = result.final.new_zeros(())
    for weight, layer, target in (
        (weights.specular, result.specular, priors.specular),
        (weights.diffuse, result.diffuse, priors.diffuse),
    ):
        if weight and layer is not None:
            # Over all pixels like the picture's own term, so that before nothing it does not outweigh it.
            share = weight * priors.separated_share
            total = total + share * photometric_loss(layer, target, priors.separated, ssim_weight)
    return total


def normal_terms(
    result: RenderResult,
    weights: Weights,
    priors: ViewPriors | None,
    camera: Camera | None,
    shading: ShadingModel,
) -> Tensor:
    """The weighted sum of the terms that read the rendered normal.

    On the CPU in float32 they are one native pass, but for the Stokes term of a shading model with a prediction of its
    own. ``normal_terms_reference`` is the reference implementation.

    Args:
        result: the rendered layers. weights: of the stage.
        priors: of the view; None: the terms that compare with them are left out.
        camera: of the view; None: the consistency is left out.
        shading: of the stage.
    """
    if not _native_fits(result, priors):
        return normal_terms_reference(result, weights, priors, camera, shading)
    stokes, directions, consistency, beside = None, [], None, result.alpha.new_zeros(())
    if priors is not None:
        assert result.normal is not None
        directions = [
            Directions(target, weight, factor / float(total), plane)
            for factor, target, weight, total, plane in (
                (weights.normal, nearest_target(result.normal, priors), priors.weight, priors.total, False),
                (weights.azimuth, priors.plane, priors.weight, priors.total, True),
                (
                    weights.chromatic,
                    priors.chromatic,
                    priors.chromatic_weight,
                    priors.chromatic_total,
                    False,
                ),
            )
            if factor
        ]
        if weights.stokes and shading.reflects and not shading.smooth_dielectric:
            beside = weights.stokes * stokes_loss(result, priors, shading)
        elif weights.stokes and shading.reflects:
            measured, index = priors.stokes[1:], shading.refractive_index
            factor = weights.stokes / measured.numel()
            stokes = Polarization(measured, S1_AND_S2, priors.stokes_weight, factor, index, result.index)
    if weights.consistency and camera is not None:
        factor = weights.consistency / ((result.alpha.shape[0] - 2) * (result.alpha.shape[1] - 2))
        consistency = Consistency(None if priors is None else priors.surface, factor)
    terms = Terms(stokes, directions, consistency)
    if not any(terms):
        return beside
    of = camera if priors is None else priors.camera
    assert of is not None
    return beside + pixel_terms(result, of, terms)


def _native_fits(result: RenderResult, priors: ViewPriors | None) -> bool:
    """Whether the native pass takes these pictures."""
    rendered = result.normal, result.specular, result.diffuse, result.depth, result.alpha
    compared = () if priors is None else (priors.stokes, priors.weight, priors.plane, priors.chromatic)
    return result.normal is not None and min(result.alpha.shape) >= 3 and fits(*rendered, *compared)


def normal_terms_reference(
    result: RenderResult,
    weights: Weights,
    priors: ViewPriors | None,
    camera: Camera | None,
    shading: ShadingModel,
) -> Tensor:
    """The reference implementation of ``normal_terms``: plain torch, any dtype and device."""
    total = result.final.new_zeros(())
    if priors is not None:
        for weight, loss in (
            (weights.normal, normal_loss),
            (weights.azimuth, azimuth_loss),
            (weights.chromatic, chromatic_loss),
        ):
            if weight and result.normal is not None:
                total = total + weight * loss(result.normal, priors)
        if weights.stokes and shading.reflects:
            total = total + weights.stokes * stokes_loss(result, priors, shading)
    if weights.consistency and camera is not None:
        total = total + weights.consistency * consistency_loss(
            result, camera, None if priors is None else priors.surface
        )
    return total
