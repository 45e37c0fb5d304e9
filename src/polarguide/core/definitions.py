"""Digest of functions, classes and objects that a user defines, such as a loss term or a metric."""

from __future__ import annotations

import hashlib
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from types import CellType, CodeType, FunctionType, MappingProxyType, ModuleType
from typing import Any

import torch
from torch import Tensor

_PLAIN = (bool, int, float, complex, str, bytes, type(None), type(...))
_INSTALLED = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
_WRAPPED = ("__wrapped__", "fget", "fset", "fdel")
"""Attributes in which decorators and properties keep the functions of the user."""
_CODE = (
    "co_code",
    "co_consts",
    "co_names",
    "co_varnames",
    "co_freevars",
    "co_cellvars",
    "co_flags",
    "co_argcount",
    "co_posonlyargcount",
    "co_kwonlyargcount",
    "co_exceptiontable",
)
"""Attributes of compiled code that determine its results. Line numbers and file names are not among them."""


def definition_digest(*definitions: Any) -> str:
    """Hash functions, classes and objects together with the user's definitions and values that they use.

    A function counts with its compiled code, default values, closure, and the globals that the code names. A class
    counts with its bases and members, and an object with its class and the state that pickle would write. Definitions
    of this project and of installed packages count with their names.

    Args:
        definitions: functions, classes, or objects.

    Returns:
        Sixteen hexadecimal digits.
    """
    return _digest(definitions, {})[:16]


def _digest(item: Any, known: dict[int, tuple[Any, str]]) -> str:
    """Return the digest of an item and its parts.

    Args:
        item: any object.
        known: items by identity, with their digests. Their references keep the identities unique.
    """
    if id(item) not in known:
        known[id(item)] = (item, "cycle")
        text, parts = _content(item)
        digests = [_digest(part, known) for part in parts]
        if isinstance(item, set | frozenset):
            digests.sort()
        lines = "\n".join((type(item).__qualname__, text, *digests))
        known[id(item)] = (item, hashlib.sha256(lines.encode(errors="surrogatepass")).hexdigest())
    return known[id(item)][1]


def _content(item: Any) -> tuple[str, Iterable[Any]]:
    """Return the text of an item itself, and its parts."""
    if type(item) in _PLAIN:
        return repr(item), ()
    if isinstance(item, Tensor):
        dense = item.detach().cpu().to_dense().resolve_conj().resolve_neg()
        values = dense.reshape(-1).contiguous().view(torch.uint8)
        return f"{item.dtype} {tuple(item.shape)}", (values.numpy().tobytes(),)
    if isinstance(item, CodeType):
        return "", [getattr(item, name, None) for name in _CODE]
    if isinstance(item, FunctionType | type | ModuleType) and not _is_own(item):
        return f"{getattr(item, '__module__', '')}.{getattr(item, '__qualname__', item.__name__)}", ()
    if isinstance(item, FunctionType):
        return "", (item.__code__, item.__defaults__, item.__kwdefaults__, vars(item), *_named_values(item))
    if isinstance(item, type):
        return item.__qualname__, (*item.__bases__, *_members(item))
    if isinstance(item, ModuleType):
        return item.__name__, ()
    if type(item) in (dict, MappingProxyType):
        return "", [part for pair in item.items() for part in pair]
    if type(item) in (tuple, list) or isinstance(item, set | frozenset):
        return "", (type(item), *item)
    return _state(item)


def _named_values(function: FunctionType) -> Iterator[Any]:
    """Yield the values of the names in the code of a function: from its closure, globals, and the user's modules."""
    code = function.__code__
    cells = zip(code.co_freevars, function.__closure__ or (), strict=True)
    closure = {name: cell.cell_contents for name, cell in cells if cell != CellType()}
    names = [*code.co_freevars, *_names(code)]
    scopes = [closure, function.__globals__]
    for scope in scopes:  # the loop appends the user's modules
        for name in names:
            value = scope.get(name)
            if not isinstance(value, ModuleType) or not _is_own(value):
                yield value
            elif not any(vars(value) is other for other in scopes):
                scopes.append(vars(value))


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names of globals and attributes in compiled code, including nested functions and comprehensions."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _members(definition: type) -> Iterator[Any]:
    """Yield names and values of the members of a class, without the data that Python adds."""
    for name, value in vars(definition).items():
        if not name.startswith("__") or callable(value) or hasattr(value, "__func__"):
            yield name
            yield value


def _state(item: Any) -> tuple[str, Iterable[Any]]:
    """Return the state of an object as pickle reads it, or else its attributes and wrapped functions."""
    try:
        state = item.__reduce_ex__(2)
    except Exception:  # the class may be of the user, and may raise any error
        state = ""
    if isinstance(state, str):
        wrapped = (getattr(item, name, None) for name in _WRAPPED)
        return state, (type(item), getattr(item, "__dict__", None), *wrapped)
    return "", [tuple(part) if isinstance(part, Iterator) else part for part in state]


def _is_own(item: Any) -> bool:
    """Return True if a definition or module is the user's, not of this project or of an installed package."""
    name = item.__name__ if isinstance(item, ModuleType) else getattr(item, "__module__", None) or ""
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", ())), None)
    if file is None and isinstance(item, FunctionType):
        file = item.__code__.co_filename
    is_installed = (
        file is None or file.startswith(_INSTALLED) or name.partition(".")[0].startswith("polarguide")
    )
    return name == "__main__" or not is_installed
