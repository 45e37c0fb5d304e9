"""``--threads`` for every library that computes with threads."""

from __future__ import annotations

import importlib


def use_threads(threads: int) -> None:
    """Let our kernels, torch and OpenCV use this many threads; 0 leaves their defaults."""
    if threads:
        importlib.import_module("polarguide.raster").use_threads(threads)
        importlib.import_module("cv2").setNumThreads(threads)
