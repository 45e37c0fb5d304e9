"""COLMAP models: the only room that knows pycolmap."""

import contextlib
import importlib

from polarguide.system import sigterm_kept

# It prints a stack trace at SIGTERM, where a process that is asked to end should just end.
with contextlib.suppress(ImportError), sigterm_kept():
    importlib.import_module("pycolmap")
