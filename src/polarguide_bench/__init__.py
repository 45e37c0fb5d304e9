"""Comparisons of recipes with tables and reports, batch processing of captures, ablations, and the baseline GNeRP."""
