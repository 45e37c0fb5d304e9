"""Cameras, vectors and frames, and the angles of polarizers."""
