"""Trained scenes as the files of other tools."""

from polarguide.export.splats import write_run_ply

__all__ = ["write_run_ply"]
