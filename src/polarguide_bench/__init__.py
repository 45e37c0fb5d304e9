"""Comparisons of recipes with reports, batch processing, ablations, the baseline GNeRP, and readers of datasets."""
