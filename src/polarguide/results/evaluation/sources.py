"""Which code made a result: a digest of the installed program, and the commit that it was built from."""

from __future__ import annotations

import ast
import hashlib
import inspect
import subprocess
from collections.abc import Sequence
from functools import cache, lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2]
COMMIT = "_commit.txt"
"""Beside the package's modules in a wheel: the commit it was built from, empty where that was not known."""
DIGITS = 16
NOT_TRAINING = ("results", "inspection", "viewer", "synth", "experiments", "api", "cli", "__main__.py")
"""Rooms below ``runs`` in the order of imports: no training can reach them."""


@lru_cache
def code_digest(package: Path = PACKAGE, *, training: bool = False) -> str:
    """Sixteen hexadecimal digits that change with the code of the package and with the compiled library.

    Comments and docstrings do not count, so that editing them invalidates no result.

    Args:
        package: folder of the package.
        training: only the code that a training can reach, so that a change of scoring repeats no training.
    """
    compiled = [path for path in package.glob("_native.*") if path.suffix != ".pyi"]
    left_out = NOT_TRAINING if training else ()
    code = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in left_out]
    return _digest(package, [*code, *compiled])


def model_digest(kind: type) -> str:
    """Digest of the file that defines a plug-in's shading model; empty for models of this package."""
    file = Path(inspect.getfile(kind))
    return "" if PACKAGE in file.parents else _digest(file.parent, [file])


def _digest(folder: Path, files: Sequence[Path]) -> str:
    whole = hashlib.sha256()
    for path in sorted(files):
        data = path.read_bytes()
        content = _code_hash(data) if path.suffix == ".py" else hashlib.sha256(data).hexdigest()
        whole.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return whole.hexdigest()[:DIGITS]


@cache
def _code_hash(source: bytes) -> str:
    """Of the syntax tree without docstrings; kept, since all files take seconds, and two digests share most of them."""
    tree = ast.parse(source)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


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
