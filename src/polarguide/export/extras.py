"""Libraries that only some verbs need."""

from __future__ import annotations

import importlib
from typing import Any

from polarguide.errors import PolarguideError


def needed(module: str, what: str, *, install: str = "'polarguide[export]'") -> Any:
    """Import a library that most verbs do without.

    Args:
        module: its name. what: what it is needed for, as the message says. install: what to give to pip.

    Raises:
        PolarguideError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise PolarguideError(
            what,
            expected=f"the Python package {module.partition('.')[0]}",
            found="that it is not installed",
            remedy=f"Install it: pip install {install}.",
        ) from None
