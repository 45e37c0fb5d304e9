"""Inspect a capture: check its pictures, its poses, and the polarizer angles that it states."""
