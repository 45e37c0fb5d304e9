"""Splatting of Gaussians with any channels: one interface, a slow twin, and fast backends."""

from polarguide.raster.backends import Backend, DeviceName, choose_backend
from polarguide.raster.interface import Rasterise, Rasterised, ScreenStatistic
from polarguide.raster.reference import rasterise_reference

__all__ = [
    "Backend",
    "DeviceName",
    "Rasterise",
    "Rasterised",
    "ScreenStatistic",
    "choose_backend",
    "rasterise_reference",
]
