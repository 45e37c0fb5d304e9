"""``polarguide view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.common import console, open_run, use_threads
from polarguide.raster import DeviceName
from polarguide.viewer import LOOPBACK, Viewer, photographs, shown_run


def view(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    host: str = LOOPBACK[0],
    port: int = 8080,
    device: DeviceName = "auto",
    threads: int = 0,
) -> None:
    """Look at a run in a browser: its layers from any side, beside the photographs. Ctrl-C ends it.

    Args:
        run: Run folder.
        host: Address to listen at. Others can reach it only if you give one of theirs (0.0.0.0: anyone's).
        port: To listen at; the next free one is taken if it is in use.
        device: What to compute on.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    opened = open_run(run, device=device)
    shown = shown_run(opened)
    viewer = Viewer(
        lambda: shown,
        photographs(opened.scene),
        shading=opened.shading,
        host=host,
        port=port,
        title=f"polarguide {run.resolve().name}",
    )
    announce(viewer, host)
    try:
        while True:
            viewer.serve(1.0)
    finally:
        viewer.close()


def announce(viewer: Viewer, host: str) -> None:
    """Say where to look, and warn of strangers."""
    if host not in LOOPBACK:
        console.print(
            f"[yellow]warning:[/] whoever reaches {host} over the network can look: there is no password"
        )
    console.print(f"viewer: {viewer.address}")
