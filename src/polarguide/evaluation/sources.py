"""Which code made a result: digests of the files that decide it, and the commit.

Comments, docstrings and layout do not count, so that a better word somewhere costs nobody a retraining. Recipes do not
count either: a run is known by all values of its own recipe.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import subprocess
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
TRAINED_BY = ("angles/trainer.py", "capture/reader.py", "raster/__init__.py", "recipes/__init__.py")
"""What trains, and what makes its scene, backend and shading: with all that they import, they decide the result."""
FIELDS_TRAINED_BY = ("neural/trainer.py",)
"""What trains a field beside that."""
SCORED_BY = ("evaluation/evaluate.py",)
"""What decides, beside that, the numbers of a finished training."""
DATA = "recipes"
"""What is followed but does not count."""
NATIVE = "_native"
COMMIT = "_commit.txt"
"""Beside the package's modules in a wheel: the commit it was built from, empty where that was not known."""
DIGITS = 16


@lru_cache
def training_digest(package: Path = PACKAGE) -> str:
    """Sixteen hexadecimal digits that change with the code that trains, compiled library included."""
    return digest_of(package, imported_files(package, TRAINED_BY))


@lru_cache
def scoring_digest(package: Path = PACKAGE) -> str:
    """The same for the code that renders and scores."""
    return digest_of(package, imported_files(package, TRAINED_BY + SCORED_BY))


@lru_cache
def field_digest(package: Path = PACKAGE) -> str:
    """The same for the code that trains fields, which no other training depends on."""
    return digest_of(package, imported_files(package, FIELDS_TRAINED_BY))


def model_digest(kind: type) -> str:
    """Digest of the file that defines a plug-in's shading model; empty for models of this package."""
    file = Path(inspect.getfile(kind))
    return "" if PACKAGE in file.parents else digest_of(file.parent, (file.name,))


def commit(package: Path = PACKAGE) -> str | None:
    """The commit that the program was built from, or runs from if it was not built: its own, nobody else's.

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


def imported_files(package: Path, roots: tuple[str, ...]) -> tuple[str, ...]:
    """Modules and all that they import of their own package, at once or later (in functions, by ``import_module``).

    Args:
        package: folder of the package.
        roots: modules, as paths below it.

    Returns:
        Their paths below the package, sorted, without recipes; ``_native`` for the compiled library.
    """
    found: set[str] = set()
    waiting = list(roots)
    while waiting:
        part = waiting.pop()
        if part in found:
            continue
        found.add(part)
        if part != NATIVE:
            for name in _imported_names(package, part):
                waiting += _files(package, name)
    return tuple(sorted(part for part in found if part.split("/")[0] != DATA))


def _imported_names(package: Path, part: str) -> Iterator[tuple[str, ...]]:
    """What a module imports, as steps below the package; an imported name may be a module or stand in one."""
    tree = ast.parse((package / part).read_text(encoding="utf-8"))
    typing_only = {
        id(node)
        for test in ast.walk(tree)
        if isinstance(test, ast.If) and ast.unparse(test.test).endswith("TYPE_CHECKING")
        for line in test.body
        for node in ast.walk(line)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = [package.name, *part.split("/")][: -node.level] if node.level else []
            start = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{start}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names = [str(word.value) for word in node.args if isinstance(word, ast.Constant)]
        for name in names:
            first, *steps = name.split(".")
            if first == package.name:
                yield tuple(steps)


def _files(package: Path, steps: tuple[str, ...]) -> Iterator[str]:
    """The files that are loaded for a name: of the packages on the way, and of the module if it is one."""
    if steps[:1] == (NATIVE,):
        yield NATIVE
    for count in range(1, len(steps) + 1):
        path = "/".join(steps[:count])
        for candidate in (f"{path}/__init__.py", f"{path}.py"):
            if (package / candidate).exists():
                yield candidate


def digest_of(package: Path, parts: tuple[str, ...]) -> str:
    """The digest of some modules of a package.

    Args:
        package: folder of the package.
        parts: paths below it; ``_native`` is any compiled ``_native.*``.

    Returns:
        Hexadecimal digits. A part that does not exist counts as empty.
    """
    whole = hashlib.sha256()
    for part in parts:
        if part == NATIVE:
            contents = [p.read_bytes() for p in sorted(package.glob("_native.*")) if p.suffix != ".pyi"]
        else:
            path = package / part
            contents = [_meaning(path.read_text(encoding="utf-8"))] if path.exists() else []
        for content in contents:
            whole.update(f"{part} {hashlib.sha256(content).hexdigest()}\n".encode())
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
