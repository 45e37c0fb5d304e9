"""A run's numbers in a file, ``metrics.json``, and the code that they come from: a digest and a commit."""

from __future__ import annotations

import ast
import hashlib
import json
import math
import subprocess
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, TypedDict

import msgspec

from polarguide.core.errors import PolarguideError
from polarguide.core.files import write_text
from polarguide.core.records import decode, read_record, shortened
from polarguide.results.evaluation.metric import Metric
from polarguide.results.evaluation.scores import ViewScores, summarize
from polarguide.results.evaluation.table import (
    HIGHEST_PSNR,
    METRICS,
    OBJECT_METRICS,
    PLUGGED,
    RUN_METRICS,
    VIEW_METRICS,
)

PACKAGE = Path(__file__).parents[2]
COMMIT = "_commit.txt"
"""Beside the package's modules in a wheel: the commit it was built from, empty where that was not known."""
DIGITS = 16
NOT_TRAINING = ("results", "inspection", "viewer", "api", "cli", "__main__.py")
"""Parts of the package that no training can reach."""
BENCH = "polarguide_bench"
"""The neighboring package with the recipes of comparisons."""
BENCH_TRAINING = ("recipes.py", "gnerp")
"""Parts of that package that a training can reach."""


@lru_cache
def code_digest(package: Path = PACKAGE, *, training: bool = False) -> str:
    """Sixteen hexadecimal digits that change with the code of the package and with the compiled library.

    Comments and docstrings do not count, so that editing them invalidates no result.

    Args:
        package: folder of the package; the bench is beside it.
        training: only the code that a training can reach, so that a change of scoring repeats no training.
    """
    compiled = [path for path in package.glob("_native.*") if path.suffix != ".pyi"]
    bench = package.with_name(BENCH)
    own = [*package.rglob("*.py")]
    neighbors = [*bench.rglob("*.py")]
    if training:
        own = [path for path in own if path.relative_to(package).parts[0] not in NOT_TRAINING]
        neighbors = [path for path in neighbors if path.relative_to(bench).parts[0] in BENCH_TRAINING]
    return _digest(package.parent, [*own, *neighbors, *compiled])


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


METRICS_FILE = "metrics.json"
_WRITE_AGAIN = "Score the run again with this version: polarguide eval."


class Provenance(TypedDict):
    """Facts that are needed to repeat a run. Other fields may stand beside it."""

    recipe: str
    seed: int
    commit: str | None
    versions: dict[str, str]
    device: str
    downscale: int
    scene_hash: str


_Decibels = Annotated[float, msgspec.Meta(le=HIGHEST_PSNR)] | None


def _fields(metrics: tuple[Metric, ...], *reasons: str) -> list[Any]:
    """Fields of a record: the metrics, and reasons of those that may be null for another one than missing truth."""
    values: list[Any] = []
    for metric in metrics:
        kind = _Decibels if metric.unit == "dB" else float | None
        # A record of before its package was installed has no value of a plugged metric.
        values.append((metric.key, kind, None) if metric in PLUGGED else (metric.key, kind))
    values.sort(key=len)  # what has a default comes last
    return [*values, *((f"{key}_reason", str | None, None) for key in reasons)]


_VIEW_REASONS = ("lpips", "flip", "stokes_error")
_RUN_REASONS = (*_VIEW_REASONS, "fps", "train_seconds", "peak_memory_mib", "mesh_fscore_1")


_OBJECT = msgspec.defstruct(
    "Object",
    [
        ("pixels", int),
        ("views", int),
        *_fields(tuple(metric for metric in METRICS if metric.key in OBJECT_METRICS)),
        ("material", str | None, None),
        ("metal_share", float | None, None),
    ],
    kw_only=True,
)
"""Errors over the pixels of an object, or of all objects of a class of material, in all test views."""
_PARTS = GenericAlias(dict, (str, _OBJECT))
"""Such errors by name."""
_VIEW = msgspec.defstruct("View", _fields(VIEW_METRICS, *_VIEW_REASONS))
_RUN = msgspec.defstruct(
    "Run",
    [
        *_fields(METRICS, *_RUN_REASONS),
        ("views", Annotated[dict[str, Any], msgspec.Meta(min_length=1)]),
        ("provenance", Provenance),
        ("objects", _PARTS, msgspec.field(default_factory=dict)),
        ("materials", _PARTS, msgspec.field(default_factory=dict)),
    ],
    kw_only=True,
)


def write_metrics(
    path: str | Path,
    *,
    views: Mapping[str, ViewScores],
    run: Mapping[str, float | int | str | None],
    provenance: Mapping[str, Any],
    objects: Mapping[str, Any] | None = None,
    materials: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write ``metrics.json`` in one step: a reader sees the old file or the whole new one.

    Top level: the means of ``summarize``, the keys of ``run``, ``views``, ``objects``, ``materials`` and
    ``provenance``. NaN becomes null.

    Args:
        path: the file; its folder must exist.
        views: the scores by view name, at least one.
        run: values of ``RUN_METRICS`` by key, null where left out, and the reasons of what is null, as ``fps_reason``.
        provenance: the keys of ``Provenance``, and others as you like.
        objects, materials: errors by object and by class of material, as of ``ErrorsByObject.records``.

    Returns:
        What was written.

    Raises:
        PolarguideError: the record does not pass ``validate_metrics``.
    """
    finite: dict[str, Any] = {
        name: {key: _finite(value) for key, value in scores.items()} for name, scores in views.items()
    }
    record: dict[str, Any] = {
        **summarize(finite),
        **{metric.key: None for metric in RUN_METRICS},
        **{key: _finite(value) for key, value in run.items()},
        "views": finite,
        "objects": dict(objects or {}),
        "materials": dict(materials or {}),
        "provenance": dict(provenance),
    }
    validate_metrics(record, where=path)
    write_text(Path(path), json.dumps(record, indent=2, allow_nan=False) + "\n")
    return record


def read_metrics(run: Path) -> dict[str, Any]:
    """The scores in a run folder, as ``write_metrics`` wrote them.

    Raises:
        PolarguideError: the run has not been scored, or the file is not such a record.
    """
    path = run / METRICS_FILE
    if not path.exists():
        raise PolarguideError(
            path, expected="the scores of a run", found="none", remedy="Run polarguide eval."
        )
    record = read_record(path, dict[str, Any], remedy=_WRITE_AGAIN)
    validate_metrics(record, path)
    return record


def validate_metrics(record: Any, where: str | Path = METRICS_FILE) -> None:
    """Check a record against the schema of ``metrics.json``.

    Args:
        record: the parsed file.
        where: what an error message calls it.

    Raises:
        PolarguideError: naming the first key at fault, what was expected there, and what was found.
    """
    decode(record, _RUN, where, remedy=_WRITE_AGAIN)
    _check_reason(record, where)
    for name, scores in record["views"].items():
        decode(scores, _VIEW, f"{where}, view {name}", remedy=_WRITE_AGAIN)
        _check_reason(scores, f"{where}, view {name}")


def _check_reason(scores: Mapping[str, Any], where: object) -> None:
    """Refuse an absent LPIPS without a reason."""
    reason = scores.get("lpips_reason")
    if scores["lpips"] is None and not reason:
        raise PolarguideError(
            f"{where} (lpips_reason)",
            expected="a reason, because lpips is null",
            found=shortened(reason),
            remedy=_WRITE_AGAIN,
        )


def _finite(value: Any) -> Any:
    """A value as JSON can hold it."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
