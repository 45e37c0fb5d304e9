"""Division-of-focal-plane polarization sensors: from raw mosaics to intensities behind four polarizer angles."""

from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, INTERPOLATIONS, DemosaicedPicture, demosaic
from polarguide.capture.sensor.packing import PACKINGS, packed_size, unpack
from polarguide.capture.sensor.pattern import SENSORS, Pattern, sensor_pattern
from polarguide.capture.sensor.radiometry import Levels, estimate_levels, unusable_samples
from polarguide.capture.sensor.raw_file import RAW_SUFFIXES, RawFormat, read_mosaic

__all__ = [
    "DEMOSAIC_MODES",
    "INTERPOLATIONS",
    "PACKINGS",
    "RAW_SUFFIXES",
    "SENSORS",
    "DemosaicedPicture",
    "Levels",
    "Pattern",
    "RawFormat",
    "demosaic",
    "estimate_levels",
    "packed_size",
    "read_mosaic",
    "sensor_pattern",
    "unpack",
    "unusable_samples",
]
