"""Measurement of shots: figures of regions, limits, and a golden part, for inspection lines."""
