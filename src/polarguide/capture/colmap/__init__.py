"""COLMAP models and COLMAP itself: the only package that imports pycolmap."""

import contextlib
import importlib

from polarguide.core.system import sigterm_kept

# pycolmap prints a stack trace when a process receives SIGTERM. The process should end without it.
with contextlib.suppress(ImportError), sigterm_kept():
    importlib.import_module("pycolmap")
