"""A run's numbers in a file: ``metrics.json``."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polarguide.errors import PolarguideError
from polarguide.evaluation.scores import MEAN_KEYS, PERFECT_PSNR, ViewScores, score_view, summarize

__all__ = [
    "PROVENANCE_KEYS",
    "RUN_KEYS",
    "ViewScores",
    "score_view",
    "summarize",
    "validate_metrics",
    "write_metrics",
]

RUN_KEYS = ("fps", "fps_layers", "train_seconds", "gaussians", "steps", "peak_memory_mib")
"""The keys that belong to a run, not to a view. Each may be null."""

PROVENANCE_KEYS = ("recipe", "seed", "commit", "versions", "device", "downscale", "scene_hash")
"""What has to be known to repeat a run."""


def write_metrics(
    path: str | Path,
    *,
    views: Mapping[str, ViewScores],
    run: Mapping[str, float | int | None],
    provenance: Mapping[str, Any],
) -> dict[str, Any]:
    """Write ``metrics.json`` in one step: a reader sees the old file or the whole new one.

    Top level: the means of ``summarize``, the keys of ``run``, ``views`` and ``provenance``. Numbers are
        finite: NaN
    and infinity become null, an infinite PSNR ``PERFECT_PSNR``.

    Args:
        path: the file; its folder must exist.
        views: the scores by view name, at least one.
        run: values for keys of ``RUN_KEYS``; one that is left out is null.
        provenance: the keys of ``PROVENANCE_KEYS``, and others as you like.

    Returns:
        What was written.

    Raises:
        PolarguideError: the record does not pass ``validate_metrics``.
    """
    path = Path(path)
    clean: dict[str, Any] = {
        name: {k: _clean(k, v) for k, v in scores.items()} for name, scores in views.items()
    }
    record: dict[str, Any] = {
        **summarize(clean),
        **dict.fromkeys(RUN_KEYS),
        **{key: _clean(key, value) for key, value in run.items()},
        "views": clean,
        "provenance": dict(provenance),
    }
    validate_metrics(record, where=path)
    text = json.dumps(record, indent=2, allow_nan=False) + "\n"
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)
    return record


def validate_metrics(record: Mapping[str, Any], where: str | Path = "metrics.json") -> None:
    """Check a record against the schema of ``metrics.json``.

    Args:
        record: the parsed file.
        where: what an error message calls it.

    Raises:
        PolarguideError: naming the first key at fault, what was expected there, and what was found.
    """
    if not isinstance(record, Mapping):
        raise _fault(where, "an object", record)
    _check_numbers(record, MEAN_KEYS + RUN_KEYS, where)
    _check_reason(record, where)
    views = record.get("views")
    if not isinstance(views, Mapping) or not views:
        raise _fault(f"{where}: views", "an object with at least one view", views)
    for name, scores in views.items():
        if not isinstance(scores, Mapping):
            raise _fault(f"{where}: views.{name}", "an object", scores)
        _check_numbers(scores, MEAN_KEYS, f"{where}: views.{name}")
        _check_reason(scores, f"{where}: views.{name}")
    provenance = record.get("provenance")
    if not isinstance(provenance, Mapping):
        raise _fault(f"{where}: provenance", "an object", provenance)
    for key in PROVENANCE_KEYS:
        if key not in provenance:
            raise PolarguideError(
                f"{where}: provenance.{key}",
                expected="a value (null if unknown)",
                found="no such key",
                remedy="Write the record again with this version.",
            )


def _check_numbers(record: Mapping[str, Any], keys: tuple[str, ...], where: object) -> None:
    for key in keys:
        value = record.get(key, "no such key")
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not number and value is not None:
            raise _fault(f"{where}: {key}", "a finite number or null", value)
        if value is not None and "psnr" in key and value > PERFECT_PSNR:
            raise _fault(f"{where}: {key}", f"at most {PERFECT_PSNR} dB", value)


def _check_reason(record: Mapping[str, Any], where: object) -> None:
    reason = record.get("lpips_reason")
    if record["lpips"] is None and not (isinstance(reason, str) and reason):
        raise _fault(f"{where}: lpips_reason", "a reason, because lpips is null", reason)


def _fault(where: object, expected: str, found: object) -> PolarguideError:
    return PolarguideError(
        where, expected=expected, found=repr(found)[:80], remedy="Write the record again with this version."
    )


def _clean(key: str, value: Any) -> Any:
    """A value as JSON can hold it."""
    if isinstance(value, float) and not math.isfinite(value):
        return PERFECT_PSNR if "psnr" in key and value > 0 else None
    return value
