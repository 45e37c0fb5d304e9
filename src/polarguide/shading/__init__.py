"""Shading models: from a G-buffer to the layers of a picture, with a learned light."""
