"""Splatting of Gaussians with any channels: one interface, a reference implementation, and fast backends."""

from polarguide.core.options import DeviceName
from polarguide.raster.backends import Backend, choose_backend, use_threads
from polarguide.raster.interface import Rasterize, Rasterized, ScreenStatistic, Splats
from polarguide.raster.reference import rasterize_reference

__all__ = [
    "Backend",
    "DeviceName",
    "Rasterize",
    "Rasterized",
    "ScreenStatistic",
    "Splats",
    "choose_backend",
    "rasterize_reference",
    "use_threads",
]
