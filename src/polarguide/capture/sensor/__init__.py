"""Polarization sensors with a filter on each pixel: from raw mosaics to intensities at four polarizer angles."""
