"""Trained scenes as the files of other tools."""
