"""Loss of one step: its terms, their inputs, and their weighted sum.

To add a term, add a field to ``Weights`` and a function to ``TERMS``. The field lists the rendered layers and the
targets that the term reads. A native pass computes the terms on normals, layers and depth in float32 on the CPU.
Functions in plain torch are its reference implementation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from polarguide import _native
from polarguide.core.errors import PolarguideError
from polarguide.core.native import fits
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.shading.model import ShadingModel
from polarguide.shading.result import RenderResult
from polarguide.training.photometric import partial_terms, photometric_loss, photometric_terms
from polarguide.training.targets import Step, ViewPriors

S1_AND_S2 = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Analyzers of S1 and S2 themselves."""


class PolarizationTerm(NamedTuple):
    """Loss term that compares predicted and measured polarization.

    It is ``factor * sum(weight * |a . S - measured|)`` over K measurements, all pixels and all colors. S is the Stokes
    vector of the rendered layers on a smooth dielectric (``optics.predicted_stokes``).

    Attributes:
        measured: [K, H, W, 3] measurements on the scale of Stokes vectors.
        analyzers: K vectors a. These are ``S1_AND_S2``, or (1, cos 2t, sin 2t) / 2 for a polarizer at angle t.
        weight: [H, W] weights of the pixels.
        factor: factor on the sum.
        refractive_index: refractive index of the surfaces, more than 1.
        indices: [H, W] refractive indices of the pixels. None means that all pixels have ``refractive_index``.
    """

    measured: Tensor
    analyzers: Sequence[Sequence[float]]
    weight: Tensor
    factor: float
    refractive_index: float
    indices: Tensor | None = None


class Directions(NamedTuple):
    """Loss term that compares rendered normals with given directions.

    With n the rendered normal at unit length and d the direction, it is ``factor * sum(weight * (1 - n . d))``. If
    ``plane`` is True, it is ``factor * sum(weight * |n . d|)``.

    Attributes:
        directions: [H, W, 3] unit vectors, world axes.
        weight: [H, W] weights of the pixels.
        factor: factor on the sum.
        plane: True if d is the normal of a plane that should contain n.
    """

    directions: Tensor
    weight: Tensor
    factor: float
    plane: bool


class Consistency(NamedTuple):
    """Loss term that makes blended normals agree with the normals of the depth map.

    It is ``factor * sum(weight * (alpha - n . n_depth))`` over all pixels except the border, with the blended normal n.

    Attributes:
        weight: [H, W] weights of the pixels. None means a weight of 1.
        factor: factor on the sum.
    """

    weight: Tensor | None
    factor: float


class Terms(NamedTuple):
    """Terms that the native pass computes in a step; at least one must be present.

    Attributes:
        polarization: term on the polarization, which needs the specular and the diffuse layer.
        directions: any number of terms on directions.
        consistency: term on the agreement of normals and depth, which needs the depth.
    """

    polarization: PolarizationTerm | None
    directions: Sequence[Directions]
    consistency: Consistency | None


class _PixelTerms(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, camera: Camera, terms: Terms, alpha: Tensor, metal: Tensor | None, *inputs: Tensor
    ) -> Tensor:
        tensors = [t.detach().contiguous() for t in inputs]
        gradients = [torch.zeros_like(t) for t in tensors]
        to_metal = None if metal is None else torch.zeros_like(metal)
        # The native code takes rows of pixels, and the depth as a map.
        *colors, depth = tensors
        *to_colors, to_depth = gradients
        normal, specular, diffuse = (t.view(-1, 3) for t in colors)
        to_normal, to_specular, to_diffuse = (t.view(-1, 3) for t in to_colors)
        frame = camera.rays().view(-1, 3), camera.pose(torch.float32, alpha.device).rotation
        total = 0.0
        if (p := terms.polarization) is not None:
            total += _native.polarization(
                normal,
                *frame,
                specular,
                diffuse,
                None if metal is None else metal.detach().contiguous(),
                p.measured.flatten(1, 2),
                torch.tensor(p.analyzers),
                p.weight.reshape(-1),
                p.factor,
                p.refractive_index,
                None if p.indices is None else p.indices.reshape(-1).contiguous(),
                to_normal,
                to_specular,
                to_diffuse,
                to_metal,
            )
        for d in terms.directions:
            directions = d.directions.reshape(-1, 3)
            total += _native.direction(normal, directions, d.weight.reshape(-1), d.factor, d.plane, to_normal)
        if (c := terms.consistency) is not None:
            depths = depth, alpha.detach().contiguous()
            weight = None if c.weight is None else c.weight.reshape(-1)
            total += _native.consistency(normal, *frame, *depths, weight, c.factor, to_normal, to_depth)
        ctx.save_for_backward(to_metal, *gradients)
        return alpha.new_tensor(total)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return (None, None, None, *(None if t is None else scaled(t, grad) for t in ctx.saved_tensors))


def scaled(gradient: Tensor, factor: Tensor) -> Tensor:
    """Multiply a gradient by the incoming scalar; a factor of 1 on the CPU returns the gradient itself."""
    return gradient if factor.device.type == "cpu" and float(factor) == 1 else gradient * factor


def pixel_terms(result: RenderResult, camera: Camera, terms: Terms) -> Tensor:
    """Return the sum of the terms as a scalar.

    It is differentiable in the normal, the specular and diffuse layers and the depth, but not in alpha. Values and
    gradients are finite for normals of any length, including zero. The number of threads does not change a bit of the
    result.

    Args:
        result: rendered layers that the terms read; float32 on the CPU.
        camera: camera of the view.
        terms: the terms, float32 on the CPU.

    Raises:
        ValueError: a shape differs, or a picture with a consistency term is smaller than 3 x 3.
    """
    polarized = terms.polarization is not None
    unused = result.alpha.new_empty(0, 3)
    total: Tensor = _PixelTerms.apply(
        camera,
        terms,
        result.alpha,
        _field(result) if polarized else None,
        result.normal,
        result.layers["specular"] if polarized else unused,
        result.layers["diffuse"] if polarized else unused,
        unused if terms.consistency is None else result.depth,
    )
    return total


def _field(result: RenderResult) -> Tensor | None:
    """Return the contributions of metals to the specular layer and its polarization; None without metals.

    The result is [P, 6]. Columns 0 to 2 are light, and columns 3 to 5 are its polarization over ``sin^2(zenith)``.
    """
    if (metal := result.metal) is None:
        return None
    both = torch.cat((metal.specular, metal.slope * metal.specular), dim=1)
    return both.new_zeros(result.alpha.numel(), 6).index_copy(0, metal.pixels, both)


def term(*priors: str, rendered: tuple[str, ...] = (), optional: bool = False, default: float = 0.0) -> float:
    """Define a field of ``Weights``, with the inputs of its loss term.

    Args:
        priors: fields of ``ViewPriors`` that the term reads. Views without priors are skipped.
        rendered: rendered data that the term reads: "normal", "depth" or "layers".
        optional: True if the term is also computed in views without ``priors``.
        default: weight in stages that do not specify one.
    """
    reads = {"priors": frozenset(priors), "rendered": rendered, "optional": optional}
    weight: float = field(default=default, metadata=reads)
    return weight


@dataclass(frozen=True)
class Weights:
    """Weights of the loss terms; a term with weight 0 is not computed.

    Attributes:
        photometric: compares the final picture with S0/2.
        specular, diffuse: compare the specular and diffuse layers with the separated pictures. These layers already
            contain the factor of the reflection strength.
        reflection, base: compare mirrored light and base color, without the factor of the reflection strength, with the
            separated pictures.
        normal: 1 - cosine between the rendered normal and the disambiguated polarization normal.
        azimuth: distance of the rendered normal from the plane of incidence, which follows from the AoLP alone.
        chromatic: 1 - cosine between the rendered normal and the normal from color differences, where one exists.
        stokes: compares S1 and S2, predicted from layers and normal, with the measured values.
        flatness: shortest scale of the Gaussians, in percent of the scene's extent.
        consistency: alpha - cosine between the blended normal and the normal of the rendered depth.
        coverage: alpha of the empty pixels, for subjects without a background.
    """

    photometric: float = term(default=1.0)
    specular: float = term("specular", "separated", rendered=("layers",))
    diffuse: float = term("diffuse", "separated", rendered=("layers",))
    reflection: float = term("specular", "separated", rendered=("layers",))
    base: float = term("diffuse", "separated", rendered=("layers",))
    normal: float = term("normal", "candidates", "weight", rendered=("normal",))
    azimuth: float = term("plane", "weight", rendered=("normal",))
    chromatic: float = term("chromatic", "chromatic_weight", rendered=("normal",))
    stokes: float = term("stokes", "stokes_weight", rendered=("normal", "layers"))
    flatness: float = term()
    consistency: float = term("surface", rendered=("normal", "depth"), optional=True)
    coverage: float = term(default=0.1)

    @property
    def priors(self) -> bool:
        """True if a term needs the priors of a view."""
        return any(use.metadata["priors"] and not use.metadata["optional"] for use in self._used())

    def own_terms(self) -> Sequence[Callable[[Step, Any], Tensor | None]]:
        """Return the terms of the weights that a subclass of another package adds.

        Each term returns its weighted loss, or None without data to compare.
        """
        return ()

    @property
    def rendered(self) -> frozenset[str]:
        """Layers that the terms read: "normal", "depth" or "layers"."""
        return frozenset().union(*(use.metadata["rendered"] for use in self._used()))

    @property
    def fields_read(self) -> frozenset[str]:
        """Fields of ``ViewPriors`` that the terms read."""
        return frozenset().union(*(use.metadata["priors"] for use in self._used()))

    @classmethod
    def known_priors(cls) -> frozenset[str]:
        """Return the fields of ``ViewPriors`` that any term reads."""
        return frozenset().union(*(weight.metadata["priors"] for weight in fields(cls)))

    def _used(self) -> list[Field[Any]]:
        return [weight for weight in fields(self) if getattr(self, weight.name)]


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Compute unit normals of a depth map by central differences, facing the camera.

    Args:
        depth: [H, W] camera depth, positive.
        camera: camera of the picture.

    Returns:
        [H, W, 3] in world axes, differentiable; zero on the border and for three collinear points.
    """
    rays = camera.rays(dtype=depth.dtype, device=depth.device)
    points = rays / rays[..., 2:] * depth[..., None]
    # In units of the depth, so that the threshold of ``unit`` for zero length has the same meaning near and far.
    scale = 1 / depth.detach().clamp(min=1e-6)[1:-1, 1:-1, None]
    across = (points[1:-1, 2:] - points[1:-1, :-2]) * scale
    down = (points[2:, 1:-1] - points[:-2, 1:-1]) * scale
    return pad(camera.to_world(unit(torch.linalg.cross(down, across))), (0, 0, 1, 1, 1, 1))


def consistency_loss(result: RenderResult, camera: Camera, weight: Tensor | None = None) -> Tensor:
    """Return the mean of ``alpha - n . n_depth``, with the blended normal ``n``.

    It is 0 if blended normals agree with each other and with the depth. A picture without an inner pixel has no depth
    normals, and its loss is 0.

    Args:
        result: rendering with the depth and the blended normal. The latter is the sum of unit normals times weights
            that add up to alpha.
        camera: camera of the view.
        weight: [H, W] weights of the pixels. None means a weight of 1.
    """
    if min(result.alpha.shape) < 3:
        return result.alpha.new_zeros(())
    cosine = dot(result.normal, depth_normals(result.depth, camera))
    distance = result.alpha.detach() - cosine
    return (distance if weight is None else weight * distance)[1:-1, 1:-1].mean()


def mean_divisor(weight: Tensor, share: float) -> Tensor:
    """Return the divisor of a weighted mean: the sum of the weights [H, W], but at least a share of the pixels."""
    return weight.sum().clamp(min=max(1.0, share * weight.numel()))


def nearest_target(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Return the target normals [H, W, 3] of the normal term.

    These are the candidates nearest to the rendered normals. If the priors have no candidates, these are the normals
    that the frozen Gaussians selected.

    Args:
        normal: [H, W, 3] blended normals, world axes, any length; gets no gradient.
        priors: priors of the view.
    """
    if priors.candidates is None:
        return priors.normal
    nearest = dot(normal.detach()[..., None, :], priors.candidates).argmax(dim=-1)
    return torch.take_along_dim(priors.candidates, nearest[..., None, None], dim=-2).squeeze(-2)


def normal_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Return the weighted mean of 1 - cos(normal, target), the normal term of Shan et al. 2026.

    The target of each pixel is ``nearest_target``.

    Args:
        normal: [H, W, 3] blended normals, world axes, any length.
        priors: priors of the view.
    """
    cosine = dot(unit(normal, 1e-2), nearest_target(normal, priors))
    return ((1 - cosine) * priors.weight).sum() / mean_divisor(priors.weight, priors.azimuth_share)


def azimuth_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Return the mean distance |n . e| of the normal from the plane of incidence of the AoLP.

    The plane does not depend on the refractive index or on the mixture of specular and diffuse light. A zenith computed
    from the DoLP depends on both.
    """
    distance = dot(unit(normal, 1e-2), priors.plane).abs()
    return (distance * priors.weight).sum() / mean_divisor(priors.weight, priors.azimuth_share)


def chromatic_loss(normal: Tensor, priors: ViewPriors) -> Tensor:
    """Return the mean of 1 - cosine between the rendered normal and the normal from color differences.

    The mean is over the pixels that have a normal from color differences.

    Args:
        normal: [H, W, 3] blended normals, world axes, any length.
        priors: priors of the view.
    """
    cosine = dot(unit(normal, 1e-2), priors.chromatic)
    divisor = mean_divisor(priors.chromatic_weight, priors.chromatic_share)
    return ((1 - cosine) * priors.chromatic_weight).sum() / divisor


def stokes_loss(result: RenderResult, priors: ViewPriors, shading: ShadingModel) -> Tensor:
    """Return the mean of |predicted - measured| over the square root of S0, for S1 and S2.

    The shading model predicts S1 and S2 from the rendered layers and the rendered normal. Geometry and layers therefore
    have to explain the polarization of all views. ``priors.stokes_weight`` explains the square root.

    Args:
        result: rendering with the specular and diffuse layers and the normal.
        priors: priors of the view.
        shading: shading model, with the refractive index of the run.
    """
    predicted = shading.predicted_stokes(result, priors.camera)
    distance = (predicted[1:] - priors.stokes[1:]).abs().mean(dim=(0, -1))
    return (priors.stokes_weight * distance).mean()


def flatness_loss_reference(log_scales: Tensor, radii: Tensor, extent: float) -> Tensor:
    """Compute ``flatness_loss`` in plain torch: the reference implementation, for any dtype and device."""
    visible = (radii > 0).to(log_scales)
    total = (log_scales.min(dim=1).values.exp() * visible).sum()
    return 100 / extent * total / visible.sum().clamp(min=1)


class _Flatness(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, radii: Tensor, extent: float) -> Tensor:
        inputs = log_scales.detach().contiguous(), radii.detach().contiguous()
        total, count = _native.shortest_sum(*inputs)
        ctx.save_for_backward(*inputs)
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
    """Return the mean shortest scale of the visible Gaussians in percent of the scene's extent.

    A native pass computes it in float32 on the CPU; ``flatness_loss_reference`` is the reference implementation.

    Args:
        log_scales: [N, 3] logarithms of the scales.
        radii: [N] radii in pixels; 0 for invisible Gaussians.
        extent: extent of the scene.
    """
    if not fits(log_scales, radii):
        return flatness_loss_reference(log_scales, radii, extent)
    loss: Tensor = _Flatness.apply(log_scales, radii, extent)
    return loss


def coverage_loss(alpha: Tensor, empty: Tensor) -> Tensor:
    """Return the mean alpha of the empty pixels.

    Args:
        alpha: [H, W] rendered alpha.
        empty: [H, W] 1 for empty pixels.
    """
    return (alpha * empty).sum() / empty.sum().clamp(min=1)


class StepLoss(NamedTuple):
    """Loss of a step, and values for its report.

    Attributes:
        total: weighted sum of the terms of a stage.
        photometric: value of the photometric term alone.
        error: mean squared difference between picture and photograph as displayed, over valid pixels, without a
            gradient.
    """

    total: Tensor
    photometric: Tensor
    error: Tensor

    def measured(self) -> Tensor:
        """Return ``StepReport.measured``."""
        psnr = -10 * torch.log10(self.error.clamp(min=1e-10))
        return torch.stack((self.photometric.detach(), psnr, self.total.detach()))


def refuse_diverged(total: Tensor) -> None:
    """Check that all losses are finite.

    On a GPU this check waits for the device. The loop therefore checks many steps at once.

    Raises:
        PolarguideError: a loss is not finite.
    """
    if not bool(torch.isfinite(total).all()):
        raise PolarguideError(
            "training",
            expected="a finite loss",
            found=str(float(total.sum())),
            remedy="Check the pictures and poses (polarguide inspect). In your own recipe, lower the rates.",
        )


def layer_terms(step: Step, weights: Weights) -> Tensor | None:
    """Return the weighted sum of the terms that compare layers with the separated pictures."""
    result = step.result
    priors = step.targets.priors
    if priors is None or not (weights.specular or weights.diffuse or weights.reflection or weights.base):
        return None
    total = result.final.new_zeros(())
    separated_share = priors.separated.mean()
    for weight, layer, target in (
        (weights.specular, "specular", priors.specular),
        (weights.diffuse, "diffuse", priors.diffuse),
        (weights.reflection, "reflection", priors.specular),
        (weights.base, "base", priors.diffuse),
    ):
        if weight and layer in result.layers:
            # The mean is over all pixels, as in the photometric term. In views with few usable pixels, this term must
            # not outweigh the photometric term.
            loss = photometric_loss(result.layers[layer], target, priors.separated, step.ssim_weight)
            total = total + weight * separated_share * loss
    return total


def flatness_term(step: Step, weights: Weights) -> Tensor | None:
    """Return the weighted flatness of the visible Gaussians."""
    if not weights.flatness:
        return None
    log_scales = step.gaussians["log_scales"]
    return weights.flatness * flatness_loss(log_scales, step.result.training["radii"], step.extent)


def coverage_term(step: Step, weights: Weights) -> Tensor | None:
    """Return the weighted alpha of the empty pixels."""
    empty = step.targets.empty
    if empty is None or not weights.coverage:
        return None
    return weights.coverage * coverage_loss(step.result.alpha, empty)


def normal_terms(step: Step, weights: Weights) -> Tensor:
    """Return the weighted sum of the terms that read the rendered normal.

    In float32 on the CPU, one native pass computes all terms. The exception is the Stokes term of a shading model that
    predicts Stokes vectors in its own way. ``normal_terms_reference`` is the reference implementation. For a view
    without priors, only the consistency term is computed.
    """
    result = step.result
    priors = step.targets.priors
    shading = step.shading
    if not _native_fits(result, priors):
        return normal_terms_reference(step, weights)
    has_kernel = type(shading).predicted_stokes is ShadingModel.predicted_stokes
    stokes = None
    directions = []
    consistency = None
    further = result.alpha.new_zeros(())
    if priors is not None:
        total = mean_divisor(priors.weight, priors.azimuth_share)
        chromatic_total = mean_divisor(priors.chromatic_weight, priors.chromatic_share)
        target = nearest_target(result.normal, priors)
        directions = [
            Directions(direction, weight, factor / float(divisor), plane)
            for factor, direction, weight, divisor, plane in (
                (weights.normal, target, priors.weight, total, False),
                (weights.azimuth, priors.plane, priors.weight, total, True),
                (weights.chromatic, priors.chromatic, priors.chromatic_weight, chromatic_total, False),
            )
            if factor
        ]
        if weights.stokes and "specular" in shading.layers and not has_kernel:
            further = weights.stokes * stokes_loss(result, priors, shading)
        elif weights.stokes and "specular" in shading.layers:
            measured = priors.stokes[1:]
            stokes = PolarizationTerm(
                measured,
                S1_AND_S2,
                priors.stokes_weight,
                weights.stokes / measured.numel(),
                shading.refractive_index,
                result.layers.get("index"),
            )
    if weights.consistency:
        factor = weights.consistency / ((result.alpha.shape[0] - 2) * (result.alpha.shape[1] - 2))
        consistency = Consistency(None if priors is None else priors.surface, factor)
    terms = Terms(stokes, directions, consistency)
    return further + pixel_terms(result, step.targets.camera, terms) if any(terms) else further


def _native_fits(result: RenderResult, priors: ViewPriors | None) -> bool:
    """Return True if the native pass supports these pictures."""
    rendered = [result.layers.get(name) for name in ("normal", "specular", "diffuse", "depth", "alpha")]
    compared = () if priors is None else (priors.stokes, priors.weight, priors.plane, priors.chromatic)
    return "normal" in result.layers and min(result.alpha.shape) >= 3 and fits(*rendered, *compared)


def normal_terms_reference(step: Step, weights: Weights) -> Tensor:
    """Compute ``normal_terms`` in plain torch: the reference implementation, for any dtype and device."""
    result = step.result
    priors = step.targets.priors
    shading = step.shading
    total = result.final.new_zeros(())
    if priors is not None:
        for weight, loss in (
            (weights.normal, normal_loss),
            (weights.azimuth, azimuth_loss),
            (weights.chromatic, chromatic_loss),
        ):
            if weight and "normal" in result.layers:
                total = total + weight * loss(result.normal, priors)
        if weights.stokes and "specular" in shading.layers:
            total = total + weights.stokes * stokes_loss(result, priors, shading)
    if weights.consistency:
        surface = None if priors is None else priors.surface
        total = total + weights.consistency * consistency_loss(result, step.targets.camera, surface)
    return total


Term = Callable[[Step, Weights], Tensor | None]
TERMS: tuple[Term, ...] = (layer_terms, flatness_term, normal_terms, coverage_term)
"""All terms except the photometric one, in the order of their addition.

Each function returns its weighted loss, or None if there are no data to compare. A function may compute the terms of
several weights in a single pass over the pixels.
"""


def step_loss(step: Step, weights: Weights) -> StepLoss:
    """Return the loss of a step: the weighted sum of its terms, and the error of the picture.

    Args:
        step: data of the step, with priors if a weight needs them.
        weights: weights of the stage.

    Raises:
        PolarguideError: the loss is not finite (on the CPU; see ``refuse_diverged``).
    """
    result = step.result
    targets = step.targets
    if "detached_specular" in result.training:
        lobes = {name: result.training[f"detached_{name}"] for name in ("specular", "diffuse")}
        step = replace(step, result=result.with_layers(**lobes))
    if targets.partial is None:
        picture = photometric_terms(result.final, targets.picture, targets.valid, step.ssim_weight)
        total = weights.photometric * picture.loss
    else:
        total, picture = partial_terms(step, targets.partial, weights.photometric, weights.stokes)
    for each in (*TERMS, *weights.own_terms()):
        if (loss := each(step, weights)) is not None:
            total = total + loss
    if total.device.type == "cpu":
        refuse_diverged(total.detach())
    return StepLoss(total, *picture)
