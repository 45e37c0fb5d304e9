"""Calibrate a polarization sensor with shots of a polarizer in front of a uniform light."""
