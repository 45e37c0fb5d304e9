"""Gaussians and their parameters: initialization, density control, geometry, harmonics, PLY."""
