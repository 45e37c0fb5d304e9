"""Native pass over the terms that compare normals, layers and depth per pixel, with its gradient.

It takes float32 on the CPU. The functions in ``polarguide.training.losses`` are the reference implementation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.geometry.camera import Camera
from polarguide.shading.result import RenderResult

S1_AND_S2 = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Analyzers of S1 and S2 themselves."""


class PolarizationTerm(NamedTuple):
    """``factor * sum(weight * |a . S - measured|)`` over K measurements, pixels and colors.

    S is the Stokes vector of the rendered layers on a smooth dielectric (``optics.predicted_stokes``).

    Attributes:
        measured: [K, H, W, 3] on the scale of Stokes vectors.
        analyzers: K vectors a: ``S1_AND_S2``, or (1, cos 2t, sin 2t) / 2 of a polarizer at angle t.
        weight: [H, W] weights of the pixels.
        factor: factor on the sum.
        refractive_index: refractive index of the surfaces, more than 1.
        indices: [H, W] refractive indices of the pixels; None: the same everywhere.
    """

    measured: Tensor
    analyzers: Sequence[Sequence[float]]
    weight: Tensor
    factor: float
    refractive_index: float
    indices: Tensor | None = None


class Directions(NamedTuple):
    """``factor * sum(weight * (1 - n . d))``, with ``plane`` of ``|n . d|``, n the normal at unit length.

    Attributes:
        directions: [H, W, 3] unit, world axes.
        weight: [H, W] weights of the pixels.
        factor: factor on the sum.
        plane: d is the normal of a plane that contains n.
    """

    directions: Tensor
    weight: Tensor
    factor: float
    plane: bool


class Consistency(NamedTuple):
    """``factor * sum(weight * (alpha - n . n_depth))`` over all pixels except the border, with the blended normal n.

    Attributes:
        weight: [H, W] weights of the pixels; None: 1.
        factor: factor on the sum.
    """

    weight: Tensor | None
    factor: float


class Terms(NamedTuple):
    """The terms of a step; at least one.

    Attributes:
        polarization: term that needs both layers.
        directions: any number of terms.
        consistency: term that needs the depth.
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
    """Multiply a gradient by the incoming scalar, which is mostly 1."""
    return gradient if factor.device.type == "cpu" and float(factor) == 1 else gradient * factor


def pixel_terms(result: RenderResult, camera: Camera, terms: Terms) -> Tensor:
    """Return the sum of terms as a scalar, differentiable in the normal, both layers and the depth, not in alpha.

    Values and gradients are finite for normals of any length, including zero. The bits do not depend on the number of
    threads.

    Args:
        result: rendered layers of the terms; float32 on the CPU.
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
    """Return the metals' part of the specular layer and of its polarization over ``sin^2(zenith)``, [P, 6]; None: no
    metal.
    """
    if (metal := result.metal) is None:
        return None
    both = torch.cat((metal.specular, metal.slope * metal.specular), dim=1)
    return both.new_zeros(result.alpha.numel(), 6).index_copy(0, metal.pixels, both)
