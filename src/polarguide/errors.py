"""The one exception that means: the user's input or environment is at fault, and this is what to do."""

from __future__ import annotations

import importlib
import importlib.util
import os
from typing import Any

from polarguide.installation import install_extra, install_package


class PolarguideError(Exception):
    """A mistake in what was given to the program.

    The message names the file or field, what was expected, what was found, and what to do. The command line
    prints it as one line without a traceback.

    Args:
        where: the file, folder, flag or field.
        expected: what should have been there.
        found: what was there.
        remedy: what to do about it.
    """

    def __init__(self, where: object, *, expected: str, found: str, remedy: str) -> None:
        super().__init__(f"{where}: expected {expected}, found {found}. {remedy}")
        self.where = str(where)
        self.is_path = isinstance(where, os.PathLike)  # one may be called like an option
        self.expected = expected
        self.found = found
        self.remedy = remedy


class PolarguideWarning(UserWarning):
    """Something that the user should know before relying on a result."""


def require_package(module: str, what: str) -> None:
    """Check that a package is there, without loading it: before work begins, not after.

    Raises:
        PolarguideError: it is not installed.
    """
    try:
        there = importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # a package that says itself that it is none
        there = False
    if not there:
        raise _missing(module, what)


def optional_import(module: str, what: str, *, extra: str = "") -> Any:
    """Import a library that most verbs do without: then it costs them no time, and may be missing.

    Args:
        module: its name. what: what it is needed for, as the message says. extra: the extra of polarguide that
            brings it; empty: it comes with polarguide.

    Raises:
        PolarguideError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise _missing(module, what, extra) from None


def _missing(module: str, what: str, extra: str = "") -> PolarguideError:
    command = install_extra(extra) if extra else install_package(module)
    return PolarguideError(
        what,
        expected=f"the Python package {module.partition('.')[0]}",
        found="that it is not installed",
        remedy=f"Install it with {command} and repeat the command.",
    )
