"""What is splatted of the Gaussians, from their parameters: positions, scales, opacities, and rows of features.

On the CPU in float32 one native pass each way does what a shading model describes with ``ChannelParameters``;
``splatting_reference`` asks it for its ``channels``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.camera import Camera
from polarguide.gaussians.geometry import GRAZING, shortest_axis_normals
from polarguide.native import applied, fits
from polarguide.raster.interface import Splats
from polarguide.shading.layout import Layout
from polarguide.shading.model import Parameters, ShadingModel


def splats(gaussians: Parameters, features: Tensor | None = None) -> Splats:
    """Gaussians as a rasterizer takes them, with features [N, D]; none: one that is zero."""
    means = gaussians["means"]
    return Splats(
        means,
        gaussians["quaternions"],
        gaussians["log_scales"].exp(),
        torch.sigmoid(gaussians["opacity_logits"]),
        means.new_zeros(len(means), 1) if features is None else features,
    )


def splatting(
    gaussians: Parameters,
    camera: Camera,
    shading: ShadingModel,
    *,
    sh_degree: int,
    normals: bool,
    depth: bool,
) -> tuple[Splats, Layout]:
    """Gaussians as a rasterizer takes them, with what a shading model splats, and which feature is what.

    Features are its color [N, 3], with ``normals`` unit normals (``shortest_axis_normals``) in world axes [N, 3], its
    further channels, and with ``depth`` the camera depth [N, 1] at last.

    Args:
        gaussians: with the parameters of the shading model; with ``outward`` where normals are turned to the side from
            which they are seen. sh_degree: of the base color, 0 to 3.

    Returns:
        Differentiable in the Gaussians; the same bits for any number of threads.

    Raises:
        ValueError: the degree, or a shape, is not as above.
    """
    described = shading.channel_parameters(gaussians)
    core = [gaussians[name] for name in _CORE]
    outward = gaussians.get("outward") if normals else None
    if described is None or not fits(*core, outward, *described[:-1], *described.further.values()):
        return splatting_reference(
            gaussians, camera, shading, sh_degree=sh_degree, normals=normals, depth=depth
        )
    pose = camera.pose(torch.float32, core[0].device)
    forward = pose.rotation[2].contiguous() if depth else None
    settings = _Settings(sh_degree, pose.center.contiguous(), forward, normals)
    given = applied(_Splatting, settings, *core, outward, *described[:-1], _joined(described.further))
    return Splats(*given), Layout(_widths(described.widths, normals=normals, depth=depth))


def splatting_reference(
    gaussians: Parameters,
    camera: Camera,
    shading: ShadingModel,
    *,
    sh_degree: int,
    normals: bool,
    depth: bool,
) -> tuple[Splats, Layout]:
    """The reference implementation of ``splatting``: plain torch around the model's channels, any dtype and device."""
    means = gaussians["means"]
    pose = camera.pose(means.dtype, means.device)
    if normals:
        shape = means, gaussians["quaternions"], gaussians["log_scales"]
        axes = shortest_axis_normals(*shape, pose.center, gaussians.get("outward"))
    else:
        axes = means.new_empty(len(means), 0)
    own = shading.channels(gaussians, axes, pose.center, sh_degree)
    widths = _widths({name: t.shape[1] for name, t in own.items()}, normals=normals, depth=depth)
    own |= {"normal": axes, "depth": ((means - pose.center) @ pose.rotation[2])[:, None]}
    return splats(gaussians, torch.cat([own[name] for name in widths], dim=1)), Layout(widths)


def _widths(own: Mapping[str, int], *, normals: bool, depth: bool) -> dict[str, int]:
    """Numbers of all channels, given those of the shading model, which begin with the color."""
    first, last = {"color": 3, **({"normal": 3} if normals else {})}, {"depth": 1} if depth else {}
    return {**first, **{name: width for name, width in own.items() if name != "color"}, **last}


def _joined(further: Mapping[str, Tensor]) -> Tensor | None:
    return torch.cat([*further.values()], dim=1) if further else None


_CORE = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest")


class _Settings(NamedTuple):
    degree: int
    center: Tensor
    forward: Tensor | None
    normals: bool


def _native_splatting(settings: _Settings, core: Any, others: Any) -> Any:
    """The native pass for these Gaussians, which it holds."""
    given: list[Any] = [*core, *settings, GRAZING, *others]
    return _native.Splatting(*given)


class _Splatting(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, settings: _Settings, *given: Tensor | None) -> tuple[Tensor, ...]:
        means, quaternions, *_ = given
        assert means is not None
        assert quaternions is not None
        contiguous = [None if t is None else t.detach().contiguous() for t in given]
        core = [t for t in contiguous[: len(_CORE)] if t is not None]
        made = _native_splatting(settings, core, contiguous[len(_CORE) :])
        count, light = len(means), given[len(_CORE) + 2]
        scales, opacities = means.new_empty(count, 3), means.new_empty(count)
        features = means.new_empty(count, made.channels)
        learns = any(ctx.needs_input_grad)
        mirrored = means.new_empty(count, 3) if learns and light is not None else None
        made.forward(scales, opacities, features, mirrored)
        if learns:
            ctx.settings = settings
            ctx.save_for_backward(*contiguous, scales, opacities, features, mirrored)
        return means.view_as(means), quaternions.view_as(quaternions), scales, opacities, features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *given, scales, opacities, features, mirrored = ctx.saved_tensors
        core, (outward, strength, dc, rest, metalness, further) = given[: len(_CORE)], given[len(_CORE) :]
        others = [outward, strength, dc, rest, metalness, further]
        to_core = [torch.empty_like(t) for t in core]
        to_learned = [None if t is None else torch.empty_like(t) for t in (strength, dc, rest, further)]
        results = scales, opacities, features, mirrored
        by_results = [g.contiguous() for g in grads]
        _native_splatting(ctx.settings, core, others).backward(*results, *by_results, *to_core, *to_learned)
        to_strength, to_dc, to_rest, to_further = to_learned
        return None, *to_core, None, to_strength, to_dc, to_rest, None, to_further
