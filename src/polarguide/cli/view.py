"""``polarguide view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

import polarguide
from polarguide.cli.progress import ConsoleReporter
from polarguide.cli.threads import use_threads
from polarguide.options import LOOPBACK, ComputeOptions


def view(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    host: str = LOOPBACK[0],
    port: int = 8080,
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Look at a run in a browser: its layers from any side, beside the photographs. Ctrl-C ends it.

    Args:
        run: Run folder.
        host: Address to listen at. Others can reach it only if you give one of theirs (0.0.0.0: anyone's).
        port: To listen at; the next free one is taken if it is in use.
    """
    use_threads(compute.threads)
    reporter = ConsoleReporter()
    opened = polarguide.open_run(run, device=compute.device, reporter=reporter)
    opened.view(host=host, port=port, reporter=reporter)
