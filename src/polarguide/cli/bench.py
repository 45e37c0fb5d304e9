"""``polarguide bench``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.compare import print_results
from polarguide.cli.console import JobReporter, say, use_threads
from polarguide.experiments.options import BenchOptions


def bench(
    *,
    out: Path,
    options: Annotated[BenchOptions, tyro.conf.arg(name="")],
) -> None:
    """Run the bench of generality: render its scenes where they are missing, and compare all methods on them.

    Scenes go to scenes/ of the folder given by --out, tables and report to development/ or held-back/. What is finished
    is checked and not repeated; after Ctrl-C the same command goes on. Rendering needs Mitsuba, as ``synth`` does.

    Args:
        out: Folder to write.
    """
    use_threads(options.threads)
    run_bench = importlib.import_module("polarguide.experiments.bench").run_bench
    results = run_bench(out, options, reporter=JobReporter())
    if results is None:
        say(f"scenes: {out / 'scenes'}")
    else:
        print_results(results, out / options.half)
