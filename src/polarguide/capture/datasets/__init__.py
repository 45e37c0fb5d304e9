"""Readers of published polarization datasets."""
