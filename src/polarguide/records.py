"""Records that are read back from JSON files: validated, with the file and the value found in every message."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from polarguide.errors import PolarguideError


def parse_json(path: Path, data: bytes) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        PolarguideError: it is not JSON, or not an object.
    """
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise PolarguideError(
            path, expected="a JSON file", found=f"broken JSON ({error})", remedy="Correct or remove the file."
        ) from error
    if not isinstance(content, dict):
        raise PolarguideError(
            path,
            expected="a JSON object {...}",
            found=f"a JSON {type(content).__name__}",
            remedy="Correct or remove the file.",
        )
    return content
