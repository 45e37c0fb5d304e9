"""One conversion by GaussForge, in a process of its own: it can take minutes, and hears no Ctrl-C meanwhile.

``python -m polarguide.export.converter IN.ply spz|sog OUT``; what goes wrong is one line on standard error, status 1.
"""

from __future__ import annotations

import sys
from pathlib import Path

import gaussforge


def main(source: str, kind: str, target: str) -> int:
    """Convert a file; returns the exit status."""
    converted = gaussforge.GaussForge().convert(Path(source).read_bytes(), "ply", kind)
    if "error" in converted:
        print(converted["error"], file=sys.stderr)
        return 1
    Path(target).write_bytes(bytes(converted["data"]))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
