"""Cameras, vectors and frames."""
