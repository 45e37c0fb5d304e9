"""CUDA backend, which implements the interface by gsplat's projection, tiling and blending.

No other module uses gsplat. ``load_gsplat`` imports gsplat and compiles its kernels. The backend supports versions
1.5.3 and 1.6.0. ``load_gsplat`` and ``COMPILED`` handle their differences.

Pictures of gsplat differ from the definition in ``raster.interface`` (see the table in docs/explanation/gpu.md). Alpha
is at most 0.999 in 1.5.3 and 0.99 in 1.6.0. Blending also ends at a transmittance of exactly 1e-4. The radius is half
of the longer side of the drawn box, in whole pixels, and at most 3.33 standard deviations. Exponentials are
approximate. Inputs are not searched for NaN, because the process would wait for the device.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from polarguide.core.errors import PolarguideError, install_extra
from polarguide.geometry.camera import Camera
from polarguide.raster.interface import (
    BLUR,
    NEAR_PLANE,
    Rasterized,
    ScreenStatistic,
    Splats,
    check_shapes,
    some_channels,
)

TILE = 16
"""Side of a tile in pixels."""
NOTICE_SECONDS = 5.0
"""Seconds of loading after which the user is informed that kernels are being compiled."""
COMPILED = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33)
"""Numbers of channels up to 33 that both versions support. Version 1.5.3 pads other numbers, and 1.6.0 rejects them."""


class _Projected(NamedTuple):
    """Projected Gaussians of one picture, sorted into tiles.

    Attributes:
        means2d: [1, N, 2] projected centers in pixels.
        conics: [1, N, 3] inverse covariances.
        opacities: [1, N] opacities.
        offsets: [1, rows, columns] index of the first intersection of each tile.
        order: [intersections] index of the Gaussian of each intersection.
        radii: [1, N, 2] radii in pixels; 0 for culled Gaussians.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    offsets: Tensor
    order: Tensor
    radii: Tensor


_views: WeakKeyDictionary[Camera, dict[torch.device, tuple[Tensor, Tensor]]] = WeakKeyDictionary()


def _view(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the world-to-camera matrix [1, 4, 4] and the intrinsics [1, 3, 3] on a device.

    Both are cached for each camera.
    """
    by_device = _views.setdefault(camera, {})
    if device not in by_device:
        pose, intrinsics = (
            t[None].to(device, torch.float32) for t in (camera.world_to_camera, camera.intrinsics)
        )
        by_device[device] = pose, intrinsics
    return by_device[device]


def has_gsplat() -> bool:
    """Return True if gsplat is installed, without importing it."""
    return importlib.util.find_spec("gsplat") is not None


def load_gsplat(say: Callable[[str], None]) -> None:
    """Import gsplat and its kernels, which are compiled at the first import.

    Both versions of gsplat compile their kernels when ``gsplat.cuda._backend`` is first imported. Without a CUDA
    toolkit they set the kernels to ``None``. A failed compilation may raise exceptions of any type.

    Args:
        say: receives a message for the user when a compilation is in progress.

    Raises:
        PolarguideError: gsplat is not installed, or its kernels cannot be loaded and compiled.
    """
    if not has_gsplat():
        raise PolarguideError(
            "--device cuda",
            expected="the package gsplat",
            found="package not installed",
            remedy=f"Install it with {install_extra('cuda')} and repeat the command, or use --device cpu.",
        )
    notice = "compiling gsplat's CUDA kernels; this takes minutes, once for each machine and PyTorch ..."
    timer = threading.Timer(NOTICE_SECONDS, say, (notice,))
    timer.daemon = True
    timer.start()
    try:
        _add_headers()
        kernels = importlib.import_module("gsplat.cuda._backend")._C
    except Exception as error:  # compilers, loaders and their drivers raise any exception
        lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        cause = next((line for line in lines if "error" in line.lower()), lines[0])
        raise _no_kernels(cause.strip()[:200]) from error
    finally:
        timer.cancel()
    if kernels is None:
        raise _no_kernels("no CUDA toolkit (nvcc)")


def _add_headers() -> None:
    """Add the headers of PyTorch's CUDA packages to the compiler's path if the toolkit lacks them.

    PyTorch's headers include headers of cuBLAS, cuSOLVER and cuSPARSE, which a bare compiler package lacks.
    """
    from torch.utils.cpp_extension import CUDA_HOME

    package = importlib.util.find_spec("nvidia")
    if CUDA_HOME is None or package is None or (Path(CUDA_HOME) / "include" / "cusparse.h").exists():
        return
    roots = [Path(root) for root in package.submodule_search_locations or ()]
    folders = sorted({str(header.parent) for root in roots for header in root.glob("*/include/*.h")})
    searched = os.environ.get("CPATH", "").split(os.pathsep)
    os.environ["CPATH"] = os.pathsep.join(dict.fromkeys([*filter(None, searched), *folders]))


def _no_kernels(found: str) -> PolarguideError:
    return PolarguideError(
        "gsplat",
        expected="its CUDA kernels, compiled at first use",
        found=found,
        remedy="Install the CUDA toolkit (nvcc) of the version that torch.version.cuda names, ninja and a C++ "
        "compiler, or a gsplat wheel with kernels for your PyTorch; or use --device cpu.",
    )


def _project(splats: Splats, camera: Camera) -> _Projected:
    gsplat = importlib.import_module("gsplat")
    size = (camera.width, camera.height)
    radii, means2d, depths, conics, _ = gsplat.fully_fused_projection(
        splats.means,
        None,
        splats.rotations,
        splats.scales,
        *_view(camera, splats.means.device),
        *size,
        eps2d=BLUR,
        near_plane=NEAR_PLANE,
        opacities=splats.opacities.detach(),  # for the size of the box and for culling
    )
    columns, rows = (-(-side // TILE) for side in size)
    _, keys, order = gsplat.isect_tiles(
        means2d.detach(), radii, depths.detach(), TILE, columns, rows, n_images=1
    )
    offsets = gsplat.isect_offset_encode(keys, 1, columns, rows).reshape(1, rows, columns)
    return _Projected(means2d, conics, splats.opacities[None], offsets, order, radii)


def _blend(projected: _Projected, features: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Blend features [N, D] to a picture [H, W, D] and alpha [H, W]."""
    channels = features.shape[1]
    padding = next(count for count in COMPILED if count >= channels) - channels
    if padding:
        features = torch.cat((features, features.new_zeros(features.shape[0], padding)), dim=1)
    picture, alpha = importlib.import_module("gsplat").rasterize_to_pixels(
        projected.means2d,
        projected.conics,
        features[None],
        projected.opacities,
        camera.width,
        camera.height,
        TILE,
        projected.offsets,
        projected.order,
    )
    return picture[0, ..., :channels], alpha[0, ..., 0]


class _AlphaAlone(torch.autograd.Function):
    """Alpha of an earlier blend; its gradient is computed by blending a zero channel, if a loss needs it.

    A statistic over all channels therefore costs nothing unless a loss depends on alpha.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        alpha: Tensor,
        projected: _Projected,
        camera: Camera,
    ) -> Tensor:
        ctx.save_for_backward(means2d, conics, opacities)
        ctx.projected = _Projected(*(t.detach() for t in projected))
        ctx.camera = camera
        return alpha.detach().clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        with torch.enable_grad():
            leaves = [t.detach().requires_grad_() for t in ctx.saved_tensors]
            projected = ctx.projected._replace(means2d=leaves[0], conics=leaves[1], opacities=leaves[2])
            zeros = leaves[0].new_zeros(leaves[0].shape[1], 1)
            _, alpha = _blend(projected, zeros, ctx.camera)
            gradients = torch.autograd.grad(alpha, leaves, grad)
        return (*gradients, None, None, None)


def _blend_with_statistic(
    projected: _Projected, features: Tensor, camera: Camera, statistic: ScreenStatistic
) -> tuple[Tensor, Tensor]:
    """Blend features, and let the backward pass store the statistic.

    In gsplat, the gradient of the projected means is a sum over all channels. A separate call therefore blends the
    channels of the statistic with a copy of the projected means. The gradient of the copy is the statistic. The sum of
    both gradients is the whole gradient, because channels are blended independently. Alphas are evaluated twice, or
    once if the statistic has all channels.
    """
    chosen = list(statistic.channels)
    others = [channel for channel in range(features.shape[1]) if channel not in chosen]
    if not chosen:
        statistic.gradient = torch.zeros_like(projected.means2d[0])
        return _blend(projected, features, camera)

    def fill(gradient: Tensor) -> None:
        statistic.gradient = gradient[0]

    own = projected.means2d.clone()
    own.register_hook(fill)
    picture, alpha = _blend(projected._replace(means2d=own), some_channels(features, chosen), camera)
    if others:
        rest, alpha = _blend(projected, some_channels(features, others), camera)
        picture = torch.cat((picture, rest), dim=-1)
    else:
        inputs = (projected.means2d, projected.conics, projected.opacities)
        alpha = _AlphaAlone.apply(*inputs, alpha, projected, camera)
    places = [(chosen + others).index(channel) for channel in range(features.shape[1])]
    return some_channels(picture, places), alpha


def rasterize_cuda(
    splats: Splats,
    camera: Camera,
    *,
    statistic: ScreenStatistic | None = None,
    still: tuple[int, ...] = (),
) -> Rasterized:
    """Splat Gaussians on a GPU in float32; see ``Rasterize``, and the module for differences."""
    check_shapes(splats, statistic, still)
    projected = _project(splats, camera)
    if statistic is not None and torch.is_grad_enabled() and projected.means2d.requires_grad:
        picture, alpha = _blend_with_statistic(projected, splats.features, camera, statistic)
    else:
        picture, alpha = _blend(projected, splats.features, camera)
    again = None
    if still:
        # A separate blend, because gsplat's kernel has one gradient for all channels.
        unmoved = _Projected(*(t.detach() for t in projected))
        again, _ = _blend(unmoved, some_channels(splats.features, still), camera)
    radii = projected.radii[0].amax(dim=-1).to(splats.means.dtype)
    return Rasterized(picture, alpha, radii, again)
