"""``polarguide share``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.common import OpenRun, console, open_run, use_threads
from polarguide.errors import PolarguideError
from polarguide.evaluation.record import METRICS_FILE, read_metrics
from polarguide.evaluation.table import shown_metrics
from polarguide.export.share import share_page, write_page


def share(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path | None = None,
    title: str = "",
    caption: str = "",
    threads: int = 0,
) -> None:
    """Write a run as one web page that renders it with its reflections, and needs nothing beside itself.

    Args:
        run: Run folder.
        out: File to write; RUN/share.html by default.
        title: Heading of the page; the scene's name by default.
        caption: Text below it; the recipe and its steps by default.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    path = out or run / "share.html"
    if path.suffix.lower() not in (".html", ".htm"):
        raise PolarguideError(
            "--out", expected="a name that ends in .html", found=str(path), remedy="Choose such a name."
        )
    opened = open_run(run, device="cpu")
    page = page_of(opened, title=title, caption=caption)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_page(path, page)
    console.print(
        f"page: {path} ({path.stat().st_size / 1e6:.1f} MB, {len(opened.state.gaussians):,} Gaussians)",
        markup=False,
    )


def page_of(opened: OpenRun, *, title: str = "", caption: str = "") -> str:
    """The page of a run; the photographs' poses are its views, the first test view is where it begins."""
    views = opened.scene.test_views + opened.scene.train_views
    configuration = opened.configuration
    scored = (opened.folder / METRICS_FILE).exists()
    scores = shown_metrics(read_metrics(opened.folder), scores_only=True) if scored else []
    return share_page(
        opened.state.gaussians,
        opened.light,
        opened.shading,
        {view.name: view.camera for view in views},
        first=views[0].name,
        title=title or opened.scene.name,
        caption=caption or f"{configuration.recipe}, {opened.state.step:,} steps",
        metrics=[
            *((f"{label}, test views", text) for label, text in scores),
            ("Gaussians", f"{len(opened.state.gaussians):,}"),
        ],
    )
