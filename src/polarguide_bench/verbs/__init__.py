"""Verbs of comparisons and collections."""
