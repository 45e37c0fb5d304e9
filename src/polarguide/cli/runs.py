"""What verbs that take a run have in common."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

import polarguide
from polarguide.cli.console import use_threads
from polarguide.cli.progress import ConsoleReporter
from polarguide.options import ComputeOptions, ThreadOptions

if TYPE_CHECKING:
    from polarguide import Run

RunFolder = Annotated[Path, tyro.conf.Positional]


def opened(run: Path, compute: ThreadOptions) -> tuple[Run, ConsoleReporter]:
    """A run with what it is to be computed on, the CPU where nothing else can be asked for; and the console."""
    use_threads(compute.threads)
    reporter = ConsoleReporter()
    device = compute.device if isinstance(compute, ComputeOptions) else "cpu"
    return polarguide.open_run(run, device=device, reporter=reporter), reporter
