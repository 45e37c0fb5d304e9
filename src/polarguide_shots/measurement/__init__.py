"""Inspection lines: figures of regions of many shots, their limits, and a golden part to compare with."""
