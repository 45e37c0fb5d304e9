"""``polarguide share``."""

from __future__ import annotations

from pathlib import Path

from polarguide.cli.console import RunFolder, opened, say, size_text
from polarguide.core.options import ThreadOptions


def share(
    run: RunFolder,
    /,
    *,
    out: Path | None = None,
    title: str = "",
    caption: str = "",
    machine: ThreadOptions = ThreadOptions(),
) -> None:
    """Write a run as one web page that renders it with its reflections, and needs nothing beside itself.

    Args:
        run: Run folder.
        out: File to write; RUN/share.html by default.
        title: Heading of the page; the scene's name by default.
        caption: Text below it; the recipe and its steps by default.
    """
    trained, _ = opened(run, machine)
    path = trained.share(out, title=title, caption=caption)
    say(f"page: {path} ({size_text(path.stat().st_size)})")
