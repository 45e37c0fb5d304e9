"""Comparisons of recipes, their tables and reports; collections of captures; ablations; and GNeRP, a baseline."""
