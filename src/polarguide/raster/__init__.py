"""Splatting of Gaussians with any channels: one interface, a slow twin, and fast backends."""

from polarguide.raster.backends import Backend, DeviceName, choose_backend
from polarguide.raster.interface import Rasterize, Rasterized, ScreenStatistic
from polarguide.raster.reference import rasterize_reference

__all__ = [
    "Backend",
    "DeviceName",
    "Rasterize",
    "Rasterized",
    "ScreenStatistic",
    "choose_backend",
    "rasterize_reference",
]
