"""Digest of the source of functions and classes that a user defines, such as a loss term or a metric."""

from __future__ import annotations

import hashlib
import inspect
import sys
import sysconfig
from collections.abc import Iterator
from types import FunctionType, ModuleType
from typing import Any

_PLAIN = (bool, int, float, str, bytes, type(None))
_INSTALLED = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))


def definition_digest(*definitions: Any) -> str:
    """Hash functions, classes and objects together with the user's definitions that they use.

    Functions are hashed by their source, and by their byte code if there is no source. Definitions of this project and
    of installed packages are not hashed.

    Args:
        definitions: functions, classes, or objects whose classes are hashed.

    Returns:
        Sixteen hexadecimal digits.
    """
    digest = hashlib.sha256()
    waiting = [*definitions]
    known: dict[int, Any] = {}
    while waiting:
        item = waiting.pop()
        if id(item) not in known:
            known[id(item)] = item
            digest.update(f"{_text(item)}\n".encode())
            waiting += _used(item)
    return digest.hexdigest()[:16]


def _text(item: Any) -> str:
    """Return the source of a function, the name of a class, or the representation of a plain value."""
    if isinstance(item, FunctionType):
        try:
            return inspect.getsource(item)
        except (OSError, TypeError):
            code = item.__code__
            return f"{code.co_code.hex()} {[c for c in code.co_consts if isinstance(c, _PLAIN)]}"
    return repr(item) if isinstance(item, _PLAIN) else getattr(item, "__qualname__", "")


def _used(item: Any) -> Iterator[Any]:
    """Yield the parts of a definition: methods, base classes, globals, closures, fields and items."""
    if isinstance(item, FunctionType):
        names = item.__code__.co_names
        values = [item.__globals__.get(name) for name in names]
        modules = [vars(value) for value in values if isinstance(value, ModuleType) and _is_own(value)]
        values += [module.get(name) for module in modules for name in names]
        values += [cell.cell_contents for cell in item.__closure__ or ()]
        yield from (value for value in values if isinstance(value, _PLAIN) or _is_own(value))
    elif isinstance(item, type):
        members = vars(item).values() if _is_own(item) else ()
        for value in (*members, *item.__bases__):
            function = getattr(value, "fget", None) or getattr(value, "__func__", value)
            if isinstance(function, FunctionType | type) and _is_own(function):
                yield function
    elif isinstance(item, tuple | list):
        yield from item
    elif not isinstance(item, _PLAIN):
        yield type(item)
        yield from vars(item).values() if hasattr(item, "__dict__") else ()


def _is_own(item: Any) -> bool:
    """Return True if a definition or module is the user's, not of this project or of an installed package."""
    name = item.__name__ if isinstance(item, ModuleType) else getattr(item, "__module__", None) or ""
    file = getattr(sys.modules.get(name), "__file__", None)
    is_installed = (
        file is None or file.startswith(_INSTALLED) or name.partition(".")[0].startswith("polarguide")
    )
    return name == "__main__" or not is_installed
