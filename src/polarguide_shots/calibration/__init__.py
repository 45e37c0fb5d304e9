"""Calibration of a polarization sensor: analyzer vectors from shots of a polarizer in front of a uniform light."""
