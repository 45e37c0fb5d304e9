"""Convert raw mosaics of polarization sensors to intensities at four polarizer angles."""
