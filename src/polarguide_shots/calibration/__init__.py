"""Calibrate a polarization sensor: analyzer vectors from shots of a polarizer before a uniform light."""
