"""``inspection.json``, the findings for programs, beside the page for people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from polarguide import __version__
from polarguide.core.files import make_folder, write_text, write_whole
from polarguide.core.progress import SILENT, Reporter
from polarguide.core.records import to_json
from polarguide.inspection.inspect import Inspection
from polarguide.inspection.page_html import FILE as PAGE
from polarguide.inspection.page_html import inspection_html
from polarguide.inspection.verdict import plain

SCHEMA = 2
"""Raised whenever a key changes its meaning or goes away; new keys do not raise it."""
FILE = "inspection.json"


def inspection_record(found: Inspection) -> dict[str, Any]:
    """The findings as plain JSON types; docs/reference/inspection.md describes the keys."""
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
            "views": [measured.record() for measured in found.measurements],
        }
    )
    return record


def write_inspection(found: Inspection, out: Path, reporter: Reporter = SILENT) -> tuple[Path, Path]:
    """Write the page and ``inspection.json`` into a folder; returns their paths.

    Raises:
        PolarguideError: they cannot be written.
    """
    make_folder(out)
    page, record = out / PAGE, out / FILE
    write_whole(record, to_json(inspection_record(found)))
    write_text(page, inspection_html(found, reporter))
    return page, record
