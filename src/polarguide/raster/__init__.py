"""Rasterizers that splat Gaussians with any channels: an interface, and backends for CPU and GPU."""

from __future__ import annotations

from collections.abc import Callable

import torch

from polarguide import _native
from polarguide.core.errors import PolarguideError
from polarguide.core.options import DeviceName
from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.cuda import has_gsplat, load_gsplat, rasterize_cuda
from polarguide.raster.interface import Backend, Rasterize, Rasterized, ScreenStatistic, Splats

__all__ = [
    "Backend",
    "DeviceName",
    "Rasterize",
    "Rasterized",
    "ScreenStatistic",
    "Splats",
    "choose_backend",
    "use_threads",
]


def choose_backend(name: DeviceName, *, say: Callable[[str], None] = lambda _: None) -> Backend:
    """Choose the backend of a device. ``auto`` selects the GPU if the machine has one and gsplat is installed.

    Args:
        name: value of ``--device``.
        say: receives messages for the user, such as the start of a compilation.

    Raises:
        PolarguideError: CUDA is requested, but the GPU, gsplat or its kernels are not available.
    """
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return Backend(torch.device("cpu"), rasterize_cpu)
    if name == "auto" and not has_gsplat():
        say("the machine has a GPU, but the package gsplat is not installed: computing on the CPU")
        return Backend(torch.device("cpu"), rasterize_cpu)
    if not torch.cuda.is_available():
        built = torch.version.cuda or "none"
        raise PolarguideError(
            "--device cuda",
            expected="a GPU",
            found=f"none that PyTorch {torch.__version__} can use (its CUDA: {built})",
            remedy="Install PyTorch with CUDA and a matching driver, or use --device cpu.",
        )
    device = torch.device("cuda", 0)
    torch.cuda.set_device(device)
    load_gsplat(say)
    return Backend(device, rasterize_cuda)


def use_threads(threads: int) -> None:
    """Set the number of threads of the native kernels and of PyTorch in this process; 0 changes nothing."""
    if threads:
        _native.set_thread_count(threads)
        torch.set_num_threads(threads)
