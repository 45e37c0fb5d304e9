"""Digests of the program's own code: which version of it trained a run, and which scored it.

Comments, docstrings and layout do not count, so that a better word somewhere costs nobody a retraining. Recipes do not
count either: a run is known by all values of its own recipe.
"""

from __future__ import annotations

import ast
import hashlib
import subprocess
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]

TRAINED_BY = (
    "vectors.py",
    "camera.py",
    "_native",
    "optics",
    "capture",
    "gaussians",
    "raster",
    "shading",
    "training",
    "cli/train.py",
)
"""What decides a training's result, below the package. ``_native`` is the compiled library."""

SCORED_BY = (
    "trained.py",
    "evaluation/metrics.py",
    "evaluation/scores.py",
    "evaluation/selection.py",
    "evaluation/target.py",
    "evaluation/lpips.py",
    "cli/evaluate.py",
)
"""What decides, beside that, the numbers of a finished training."""

DIGITS = 16


def training_digest(package: Path = PACKAGE) -> str:
    """Sixteen hexadecimal digits that change with the code that trains, compiled library included."""
    return _cached(package, TRAINED_BY)


def scoring_digest(package: Path = PACKAGE) -> str:
    """The same for the code that renders and scores."""
    return _cached(package, TRAINED_BY + SCORED_BY)


@lru_cache
def _cached(package: Path, parts: tuple[str, ...]) -> str:
    return digest_of(package, parts)


def commit() -> str | None:
    """The commit of the checkout that runs, or None where there is none."""
    command = ["git", "-C", str(PACKAGE), "rev-parse", "HEAD"]
    try:
        git = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:  # no git on this machine
        return None
    return git.stdout.strip() or None


def digest_of(package: Path, parts: tuple[str, ...]) -> str:
    """The digest of some files and folders of a package.

    Args:
        package: folder of the package.
        parts: paths below it; a folder counts with all modules in it, ``_native`` is any compiled ``_native.*``.

    Returns:
        Hexadecimal digits. A part that does not exist counts as empty.
    """
    whole = hashlib.sha256()
    for part in parts:
        if part == "_native":
            files = sorted(p for p in package.glob("_native.*") if p.suffix != ".pyi")
        elif part.endswith(".py"):
            files = [package / part] if (package / part).exists() else []
        else:
            files = sorted((package / part).rglob("*.py"))
        for path in files:
            content = (
                _meaning(path.read_text(encoding="utf-8")) if path.suffix == ".py" else path.read_bytes()
            )
            name = "_native" if part == "_native" else path.relative_to(package).as_posix()
            whole.update(f"{name} {hashlib.sha256(content).hexdigest()}\n".encode())
    return whole.hexdigest()[:DIGITS]


def _meaning(source: str) -> bytes:
    """A module without its comments, docstrings and layout."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree).encode()
