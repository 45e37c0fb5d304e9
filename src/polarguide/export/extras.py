"""Libraries that only some exports need."""

from __future__ import annotations

import importlib
from typing import Any

from polarguide.errors import PolarguideError


def needed(module: str, what: str) -> Any:
    """Import a module of the optional part ``export``.

    Args:
        module: its name. what: what it is needed for, as the message says.

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
            remedy="Install the optional part: pip install 'polarguide[export]'.",
        ) from None
