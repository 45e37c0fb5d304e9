"""The scores of a run in ``metrics.json``, and the digest and commit of the code that computed them."""

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
    PART_SHARES,
    PLUGGED,
    RUN_METRICS,
)

PACKAGE = Path(__file__).parents[2]
COMMIT = "_commit.txt"
"""File in an installed package that contains the commit of its build. It is empty if the commit is unknown."""
DIGITS = 16
NOT_TRAINING = ("results", "inspection", "viewer", "api", "cli", "__main__.py")
"""Parts of the package that training never imports."""
BENCH = "polarguide_bench"
"""Neighboring package with the recipes of comparisons."""
BENCH_TRAINING = ("recipes.py", "gnerp")
"""Parts of the bench that training imports."""


@lru_cache
def code_digest(package: Path = PACKAGE, *, training: bool = False) -> str:
    """Hash the code of the package and the compiled library to 16 hexadecimal digits.

    Comments and docstrings do not change the digest.

    Args:
        package: folder of the package. The bench is its sibling.
        training: hash only code that training imports, so that a change of the scoring does not invalidate trained
            runs.
    """
    compiled = [path for path in package.glob("_native.*") if path.suffix != ".pyi"]
    bench = package.with_name(BENCH)
    sources = [*package.rglob("*.py")]
    neighbors = [*bench.rglob("*.py")]
    if training:
        sources = [path for path in sources if path.relative_to(package).parts[0] not in NOT_TRAINING]
        neighbors = [path for path in neighbors if path.relative_to(bench).parts[0] in BENCH_TRAINING]
    return _digest(package.parent, [*sources, *neighbors, *compiled])


def _digest(folder: Path, files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in sorted(files):
        data = path.read_bytes()
        content = _code_hash(data) if path.suffix == ".py" else hashlib.sha256(data).hexdigest()
        digest.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return digest.hexdigest()[:DIGITS]


@cache
def _code_hash(source: bytes) -> str:
    """Hash the syntax tree of a source without docstrings.

    The result is cached, because the digests with and without ``training`` share most files.
    """
    tree = ast.parse(source)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def commit(package: Path = PACKAGE) -> str | None:
    """Return the commit of an installed build, or of the repository that contains the running source.

    A repository that contains the project in a subfolder is ignored.

    Args:
        package: folder of the package.

    Returns:
        The hash of the commit, or None if it is unknown.
    """
    stamp = package / COMMIT
    if stamp.exists():
        return stamp.read_text(encoding="utf-8").strip() or None
    command = ["git", "-C", str(package), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        git = subprocess.run(command, capture_output=True, text=True, check=True)
    except (
        FileNotFoundError,
        subprocess.CalledProcessError,
    ):  # Git is not installed, or there is no repository.
        return None
    top, head = git.stdout.splitlines()
    return head if Path(top, "src", package.name).resolve() == package.resolve() else None


METRICS_FILE = "metrics.json"
_REMEDY = "Score the run again with this version: polarguide eval."


class Provenance(TypedDict):
    """Facts that are needed to repeat a run. Additional fields are allowed."""

    recipe: str
    seed: int
    commit: str | None
    versions: dict[str, str]
    device: str
    downscale: int
    scene_hash: str


_Decibels = Annotated[float, msgspec.Meta(le=HIGHEST_PSNR)] | None


def _fields(metrics: Sequence[Metric], *reasons: str) -> list[Any]:
    """Return the fields of a record: the metrics, and texts that explain null values."""
    values: list[Any] = []
    for metric in metrics:
        kind = _Decibels if metric.unit == "dB" else float | None
        # A record may be older than the installation of the metric's package.
        values.append((metric.key, kind, None) if metric in PLUGGED else (metric.key, kind))
    values.sort(key=len)  # Fields with a default come last.
    return [*values, *((f"{key}_reason", str | None, None) for key in reasons)]


_VIEW_REASONS = ("lpips", "flip", "stokes_error")
_RUN_REASONS = (*_VIEW_REASONS, "fps", "train_seconds", "peak_memory_mib", "mesh_fscore_1")


_OBJECT = msgspec.defstruct(
    "Object",
    [
        ("pixels", int),
        ("views", int),
        *_fields([metric for metric in METRICS if metric.key in OBJECT_METRICS]),
        ("material", str | None, None),
        *((metric.key, float | None, None) for metric in PART_SHARES),
    ],
    kw_only=True,
)
"""Errors over the pixels of an object or a class of material in all test views."""
_PARTS = GenericAlias(dict, (str, _OBJECT))


@cache
def _structures(metrics: tuple[Metric, ...]) -> tuple[type, type]:
    """Return the types of the scores of a view, and of the record in ``metrics.json``, for all metrics."""
    view = msgspec.defstruct("View", _fields([m for m in metrics if m.of == "view"], *_VIEW_REASONS))
    run = msgspec.defstruct(
        "Run",
        [
            *_fields(metrics, *_RUN_REASONS),
            ("views", Annotated[dict[str, Any], msgspec.Meta(min_length=1)]),
            ("provenance", Provenance),
            ("objects", _PARTS, msgspec.field(default_factory=dict)),
            ("materials", _PARTS, msgspec.field(default_factory=dict)),
        ],
        kw_only=True,
    )
    return view, run


def write_metrics(
    path: str | Path,
    *,
    views: Mapping[str, ViewScores],
    run: Mapping[str, float | int | str | None],
    provenance: Mapping[str, Any],
    objects: Mapping[str, Any] | None = None,
    materials: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write ``metrics.json`` atomically.

    The top level holds the means of ``summarize``, the keys of ``run``, ``views``, ``objects``, ``materials``
    and ``provenance``. NaN becomes null.

    Args:
        path: the file; its folder must exist.
        views: scores by view name, at least one view.
        run: values of ``RUN_METRICS`` by key. A missing value is written as null. Entries such as ``fps_reason``
            explain a null.
        provenance: the keys of ``Provenance``; other keys are allowed.
        objects, materials: errors of each object and of each class of material, see ``ErrorsByObject.records``.

    Returns:
        The record.

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
    """Read the scores in a run folder.

    Raises:
        PolarguideError: the run has no scores, or the file is not a valid record.
    """
    path = run / METRICS_FILE
    if not path.exists():
        raise PolarguideError(
            path, expected="the scores of a run", found="none", remedy="Run polarguide eval."
        )
    record = read_record(path, dict[str, Any], remedy=_REMEDY)
    validate_metrics(record, path)
    return record


def validate_metrics(record: Any, where: str | Path = METRICS_FILE) -> None:
    """Validate a record against the schema of ``metrics.json``.

    Args:
        record: the parsed file.
        where: name of the record in an error.

    Raises:
        PolarguideError: the record is invalid. The error names the first invalid key.
    """
    view, run = _structures(tuple(METRICS))
    decode(record, run, where, remedy=_REMEDY)
    _check_reason(record, where)
    for name, scores in record["views"].items():
        decode(scores, view, f"{where}, view {name}", remedy=_REMEDY)
        _check_reason(scores, f"{where}, view {name}")


def _check_reason(scores: Mapping[str, Any], where: object) -> None:
    reason = scores.get("lpips_reason")
    if scores["lpips"] is None and not reason:
        raise PolarguideError(
            f"{where} (lpips_reason)",
            expected="a reason, because lpips is null",
            found=shortened(reason),
            remedy=_REMEDY,
        )


def _finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON cannot represent, by None."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
