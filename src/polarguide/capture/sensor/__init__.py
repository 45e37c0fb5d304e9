"""Division-of-focal-plane polarization sensors: from raw mosaics to intensities behind four polarizer angles."""
