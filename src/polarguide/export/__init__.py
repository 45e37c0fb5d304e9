"""Trained scenes as the files of other tools."""

from polarguide.runs.point_cloud import write_run_ply

__all__ = ["write_run_ply"]
