"""Comparisons and ablations: many runs, their tables and their report."""
