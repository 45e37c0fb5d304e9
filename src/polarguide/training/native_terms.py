"""Terms of the loss that compare normals, layers and depth pixel by pixel: a native pass, with its gradient.

Float32 on the CPU. The functions in ``polarguide.training.losses`` are the reference implementation.
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
"""The analyzers of S1 and S2 themselves."""


class PolarizationTerm(NamedTuple):
    """``factor * sum(weight * |a . S - measured|)`` over K measurements, pixels and colors.

    S is the Stokes vector of the rendered layers on a smooth dielectric (``optics.predicted_stokes``).

    Attributes:
        measured: [K, H, W, 3] on the scale of Stokes vectors.
        analyzers: K vectors a: ``S1_AND_S2``, or (1, cos 2t, sin 2t) / 2 of a polarizer at angle t.
        weight: [H, W].
        factor: on the sum. refractive_index: of the surfaces, more than 1. indices: [H, W] that of each pixel, in its
            place; None: the same everywhere.
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
        weight: [H, W].
        factor: on the sum. plane: whether d is the normal of a plane that n should lie in.
    """

    directions: Tensor
    weight: Tensor
    factor: float
    plane: bool


class Consistency(NamedTuple):
    """``factor * sum(weight * (alpha - n . n_depth))`` over all pixels but the border's; n as blended.

    Attributes:
        weight: [H, W]; None: 1. factor: on the sum.
    """

    weight: Tensor | None
    factor: float


class Terms(NamedTuple):
    """The terms of a step; at least one.

    Attributes:
        polarization: needs both layers. directions: any number. consistency: needs the depth.
    """

    polarization: PolarizationTerm | None
    directions: Sequence[Directions]
    consistency: Consistency | None


class _PixelTerms(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: Camera, terms: Terms, alpha: Tensor, *inputs: Tensor | None) -> Tensor:
        tensors = [None if t is None else t.detach().contiguous() for t in inputs]
        gradients = [None if t is None else torch.zeros_like(t) for t in tensors]
        # Pixels in a row; the depth stays a picture.
        (
            (normal, specular, diffuse, metal, depth),
            (to_normal, to_specular, to_diffuse, to_metal, to_depth),
        ) = ([t if t is None or t.ndim == 2 else t.view(-1, 3) for t in of] for of in (tensors, gradients))
        assert normal is not None
        assert to_normal is not None
        frame = camera.rays().view(-1, 3), camera.pose(torch.float32, alpha.device).rotation
        total = 0.0
        if (p := terms.polarization) is not None:
            assert specular is not None
            assert diffuse is not None
            assert to_specular is not None
            assert to_diffuse is not None
            measured = p.measured.flatten(1, 2)
            weight = p.weight.reshape(-1)
            total += _native.polarization(
                normal,
                *frame,
                specular,
                diffuse,
                metal,
                measured,
                torch.tensor(p.analyzers),
                weight,
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
            weight = d.weight.reshape(-1)
            total += _native.direction(normal, directions, weight, d.factor, d.plane, to_normal)
        if (c := terms.consistency) is not None:
            assert depth is not None
            assert to_depth is not None
            depths = depth, alpha.detach().contiguous()
            counts = None if c.weight is None else c.weight.reshape(-1)
            total += _native.consistency(normal, *frame, *depths, counts, c.factor, to_normal, to_depth)
        ctx.save_for_backward(*gradients)
        return alpha.new_tensor(total)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return (None, None, None, *(None if t is None else scaled(t, grad) for t in ctx.saved_tensors))


def scaled(gradient: Tensor, factor: Tensor) -> Tensor:
    """A gradient times the scalar that comes from above, which is mostly 1."""
    return gradient if factor.device.type == "cpu" and float(factor) == 1 else gradient * factor


def pixel_terms(result: RenderResult, camera: Camera, terms: Terms) -> Tensor:
    """The sum of terms as a scalar, differentiable in the normal, both layers and the depth (not in alpha).

    Values and gradients are finite for normals of any length, zero too; the bits do not depend on the number of
    threads.

    Args:
        result: with what the terms need; float32 on the CPU, like all that they hold.

    Raises:
        ValueError: if a shape does not fit, or a picture with a consistency term is smaller than 3 x 3.
    """
    polarized = terms.polarization is not None
    deep = terms.consistency is not None
    total: Tensor = _PixelTerms.apply(
        camera,
        terms,
        result.alpha,
        result.normal,
        result.layers["specular"] if polarized else None,
        result.layers["diffuse"] if polarized else None,
        _field(result) if polarized else None,
        result.depth if deep else None,
    )
    return total


def _field(result: RenderResult) -> Tensor | None:
    """Metals' part of the specular layer and of its polarization over ``sin^2(zenith)``, [P, 6]; None: no metal."""
    if (metal := result.metal) is None:
        return None
    both = torch.cat((metal.specular, metal.slope * metal.specular), dim=1)
    return both.new_zeros(result.alpha.numel(), 6).index_copy(0, metal.pixels, both)
