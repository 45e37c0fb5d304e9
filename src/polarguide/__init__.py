"""polarguide: polarization photographs to a Gaussian splatting scene with its reflections separated.

``polarguide.load(RUN)`` opens a trained run; see ``polarguide.api``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polarguide.api import Model, PolarguideError, load
    from polarguide.experiments.ablate import ablate
    from polarguide.experiments.compare import compare

__version__ = "0.1.0"
__all__ = ["Model", "PolarguideError", "__version__", "ablate", "compare", "load"]


def __getattr__(name: str) -> Any:
    # Only when it is asked for: the command line has to say how threads wait before torch is imported.
    if name in ("Model", "PolarguideError", "load"):
        from polarguide import api

        return getattr(api, name)
    if name in ("ablate", "compare"):
        return getattr(importlib.import_module(f"polarguide.experiments.{name}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
