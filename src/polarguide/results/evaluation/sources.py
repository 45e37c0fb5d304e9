"""Which code made a result: a digest of the installed program, and the commit that it was built from."""

from __future__ import annotations

import hashlib
import inspect
import subprocess
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2]
COMMIT = "_commit.txt"
"""Beside the package's modules in a wheel: the commit it was built from, empty where that was not known."""
DIGITS = 16


@lru_cache
def code_digest(package: Path = PACKAGE) -> str:
    """Sixteen hexadecimal digits that change with every Python file of the package and with the compiled library."""
    compiled = [path for path in package.glob("_native.*") if path.suffix != ".pyi"]
    return _digest(package, [*package.rglob("*.py"), *compiled])


def model_digest(kind: type) -> str:
    """Digest of the file that defines a plug-in's shading model; empty for models of this package."""
    file = Path(inspect.getfile(kind))
    return "" if PACKAGE in file.parents else _digest(file.parent, [file])


def _digest(folder: Path, files: Sequence[Path]) -> str:
    whole = hashlib.sha256()
    for path in sorted(files):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        whole.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return whole.hexdigest()[:DIGITS]


def commit(package: Path = PACKAGE) -> str | None:
    """The commit that the program was built from, or runs from if it was not built; never an outer repository's.

    Args:
        package: folder of the package.

    Returns:
        The hash; None where it is not known.
    """
    stamp = package / COMMIT
    if stamp.exists():
        return stamp.read_text(encoding="utf-8").strip() or None
    command = ["git", "-C", str(package), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        git = subprocess.run(command, capture_output=True, text=True, check=True)
    except (FileNotFoundError, subprocess.CalledProcessError):  # no git on this machine, or no repository
        return None
    top, head = git.stdout.splitlines()
    return head if Path(top, "src", package.name).resolve() == package.resolve() else None
