"""CPU backend: the native kernels (``native/``) as a differentiable PyTorch function, float32."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide import _native
from polarguide.core.native import applied
from polarguide.geometry.camera import Camera
from polarguide.raster.interface import (
    NEAR_PLANE,
    Rasterized,
    ScreenStatistic,
    Splats,
    check_shapes,
    not_finite,
    refusal,
    some_channels,
)


def native_rasterizer(camera: Camera, channels: int, statistic: ScreenStatistic | None) -> Any:
    """Create a native rasterizer for one picture with ``channels`` channels.

    It processes the channels of the statistic first.
    """
    chosen = list(statistic.channels) if statistic else []
    permutation = chosen + [k for k in range(channels) if k not in chosen]
    return _native.Rasterizer(
        camera.rotation.flatten().tolist(),
        camera.translation.tolist(),
        [camera.fx, camera.fy, camera.cx, camera.cy],
        camera.width,
        camera.height,
        NEAR_PLANE,
        permutation,
        len(chosen),
    )


def finite(*splats: Tensor) -> list[Tensor]:
    """Return the tensors of ``Splats`` as input of the kernels: on the CPU, contiguous and finite.

    Raises:
        PolarguideError: a value is not finite.
    """
    inputs = [t.detach().cpu().contiguous() for t in splats]
    for name, tensor in zip(Splats._fields, inputs, strict=True):
        bad = _native.first_not_finite(tensor)
        if bad >= 0:
            raise not_finite(name, bad // max(1, tensor[0].numel()))
    return inputs


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        camera: Camera,
        statistic: ScreenStatistic | None,
        still: tuple[int, ...],
        *splats: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        inputs = finite(*splats)
        count, channels = inputs[-1].shape
        rasterizer = native_rasterizer(camera, channels, statistic)
        out = torch.empty(camera.height, camera.width, channels)
        alpha = torch.empty(camera.height, camera.width)
        radii = torch.empty(count)
        rasterizer.forward(*inputs, out, alpha, radii, for_backward=any(ctx.needs_input_grad))
        ctx.mark_non_differentiable(radii)
        ctx.save_for_backward(*inputs, out)
        ctx.rasterizer = rasterizer
        ctx.statistic = statistic
        ctx.still = still
        return out, alpha, radii, some_channels(out, still).contiguous() if still else None

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad_out: Tensor, grad_alpha: Tensor, _: Tensor, grad_still: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        *inputs, out = ctx.saved_tensors
        gradients = [torch.empty_like(t) for t in inputs]
        screen = torch.empty(inputs[0].shape[0], 2) if ctx.statistic else None
        pictures = out, grad_out.contiguous(), grad_alpha.contiguous()
        still = None if grad_still is None else grad_still.contiguous()
        ctx.rasterizer.backward(*inputs, *pictures, *gradients, screen, list(ctx.still), still)
        if ctx.statistic:
            ctx.statistic.gradient = screen
        return (None, None, None, *gradients)


def rasterize_cpu(
    splats: Splats,
    camera: Camera,
    *,
    statistic: ScreenStatistic | None = None,
    still: tuple[int, ...] = (),
) -> Rasterized:
    """Splat Gaussians on the CPU in float32; see ``Rasterize``. Results do not depend on the number of threads."""
    check_shapes(splats, statistic, still)
    for name, tensor in splats._asdict().items():
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise refusal(
                name,
                "float32 on the CPU",
                f"{tensor.dtype} on {tensor.device}",
                "Convert the tensor to float32 on the CPU.",
            )
    return Rasterized(*applied(_Rasterize, camera, statistic, still, *splats))
