"""Errors in the user's input or environment, with advice on how to correct them."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import os
import re
import shlex
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple


class PolarguideError(Exception):
    """Error in the user's input or environment.

    The message names the file or field, the expected and the actual value, and a remedy. The command line prints it as
    one line without a traceback.

    Args:
        where: file, folder, option or field.
        expected: valid value, a noun phrase.
        found: actual value.
        remedy: how to correct the error, an imperative sentence.
    """

    def __init__(self, where: object, *, expected: str, found: str, remedy: str) -> None:
        super().__init__(f"{where}: expected {expected}, found {found}. {remedy}")
        self.where = str(where)
        self.is_path = isinstance(where, os.PathLike)  # its name can look like an option
        self.expected = expected
        self.found = found
        self.remedy = remedy


def require(condition: object, where: object, *, expected: str, found: str, remedy: str) -> None:
    """Check a condition on input.

    Args:
        condition: the condition.
        where, expected, found, remedy: as for ``PolarguideError``.

    Raises:
        PolarguideError: the condition does not hold.
    """
    if not condition:
        raise PolarguideError(where, expected=expected, found=found, remedy=remedy)


def unknown_view(where: object, name: str, names: Sequence[str]) -> PolarguideError:
    """Return the error for an unknown view name, with the most similar names."""
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.4) or names[:3]
    return PolarguideError(
        where,
        expected=f"the name of one of the {len(names)} views",
        found=repr(name),
        remedy=f"The nearest names are: {', '.join(near)}.",
    )


class PolarguideWarning(UserWarning):
    """Warning about the reliability of a result."""


DISTRIBUTIONS = {"pxr": "usd-core", "skimage": "scikit-image", "websockets": "viser"}
"""Distribution of each module that has another name. viser installs the version of websockets that it needs."""
_NAME = re.compile(r"[A-Za-z0-9._-]+")
_EXTRA = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


def install_extra(extra: str) -> str:
    """Return the command that installs the packages of an extra.

    The command names the packages and not the extra. In a source folder, the extra would compile polarguide again.
    """
    packages = [requirement.text for requirement in requirements() if requirement.extra == extra]
    return _pip(*(packages or [f"polarguide[{extra}]"]))


def install_package(module: str) -> str:
    """Return the command that installs a supported version of the package that contains a module."""
    module = module.partition(".")[0]
    package = _plain(DISTRIBUTIONS.get(module, module))
    specified = (requirement.text for requirement in requirements() if _plain(requirement.name) == package)
    return _pip(next(specified, package))


def _plain(name: str) -> str:
    """Return the normalized name of a distribution."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _pip(*packages: str) -> str:
    """Return a command line that runs the pip of this Python, because the shell's pip may belong to another Python."""
    executable = shutil.which("pip")
    ours = executable is not None and Path(executable).parent == Path(sys.executable).parent
    return shlex.join([*(["pip"] if ours else [sys.executable, "-m", "pip"]), "install", *packages])


class Requirement(NamedTuple):
    """Requirement of polarguide, read from its installed metadata.

    Attributes:
        name: name of the distribution.
        text: name and versions, such as ``viser==1.1.*``.
        extra: name of the extra that requires it. An empty name means that polarguide always requires it.
        conditional: True if only certain operating systems or versions of Python require it.
    """

    name: str
    text: str
    extra: str
    conditional: bool


def requirements() -> list[Requirement]:
    """Return the requirements from the installed metadata, or [] if polarguide is not installed."""
    metadata = importlib.import_module("importlib.metadata")
    try:
        lines = metadata.requires("polarguide") or []
    except metadata.PackageNotFoundError:
        return []
    listed = []
    for line in lines:
        text, _, condition = (part.strip() for part in line.partition(";"))
        extra = _EXTRA.search(condition)
        name = _NAME.match(text)
        conditional = bool(_EXTRA.sub("", condition).strip(" ()"))
        listed.append(Requirement(name[0] if name else text, text, extra[1] if extra else "", conditional))
    return listed


def require_package(module: str, what: str) -> None:
    """Check that a package is installed, without importing it, before long work begins; see ``optional_import``.

    Raises:
        PolarguideError: the package is not installed.
    """
    try:
        is_installed = importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # broken metadata of the package
        is_installed = False
    if not is_installed:
        raise _missing(module, what)


def optional_import(module: str, what: str) -> Any:
    """Import an optional library, which may be missing.

    Libraries such as dask_jobqueue replace the handler of Ctrl-C, so it is restored after the import.

    Args:
        module: name of the module.
        what: verb or option that needs the library, for the message.

    Raises:
        PolarguideError: the package is not installed.
    """
    before = signal.getsignal(signal.SIGINT)
    try:
        return importlib.import_module(module)
    except ImportError:
        raise _missing(module, what) from None
    finally:
        if before is not None and signal.getsignal(signal.SIGINT) is not before:
            signal.signal(signal.SIGINT, before)


def _missing(module: str, what: str) -> PolarguideError:
    """Return the error for a missing package."""
    return PolarguideError(
        what,
        expected=f"the Python package {module.partition('.')[0]}",
        found="package not installed",
        remedy=f"Install it with {install_package(module)} and repeat the command.",
    )


def import_part(module: str, what: str) -> Any:
    """Import a module of this package or of another package of the same distribution.

    Args:
        module: full name, such as "polarguide_shots.verbs".
        what: verb or name that needs the module, for the message.

    Raises:
        PolarguideError: the package is not installed.
    """
    package = module.partition(".")[0]
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise PolarguideError(
            what,
            expected=f"the package {package}, a part of polarguide",
            found="package not installed",
            remedy="Install polarguide again.",
        ) from None
