"""``inspection.json``: the findings for programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from polarguide import __version__
from polarguide.files import atomic
from polarguide.inspection.inspect import Inspection
from polarguide.inspection.verdict import plain

SCHEMA = 1
"""Raised whenever a key changes its meaning or goes away; new keys do not raise it."""
FILE = "inspection.json"


def inspection_record(found: Inspection) -> dict[str, Any]:
    """The findings as plain JSON types; docs/inspect.md describes the keys."""
    capture = found.capture
    record: dict[str, Any] = plain(
        {
            "schema": SCHEMA,
            "program": f"polarguide {__version__}",
            "scene": {
                "name": capture.name,
                "views": len(capture.views),
                "posed_views": len(capture.posed),
                "size": list(capture.size),
                "bits": capture.bits,
                "digest": capture.digest,
            },
            "settings": {
                "downscale": capture.factor,
                "transfer": capture.transfer,
                "refractive_index": found.index,
                "normals": found.settings.normals,
                "steps": found.settings.steps,
            },
            "verdict": found.verdict,
            "checks": [check.record() for check in found.checks],
            "angles": found.angles.record(),
            "views": [reading.record() for reading in found.readings],
        }
    )
    return record


def write_record(found: Inspection, out: Path) -> Path:
    """Write ``inspection.json`` in one step; returns its path."""
    with atomic(out / FILE) as path:
        path.write_text(json.dumps(inspection_record(found), indent=1, ensure_ascii=False) + "\n", "utf-8")
    return out / FILE
