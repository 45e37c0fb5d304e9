"""Measure regions of shots for inspection lines, and compare them with limits and with a reference part."""
