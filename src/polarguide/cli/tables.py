"""``polarguide tables``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.compare import print_results

Records = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS ...")]


def tables(records: Records, /, *, out: Path, against: str | None = None) -> None:
    """Join the records of comparisons that were run apart, and set their tables anew.

    For comparisons and benches that are spread over machines or days: scenes, seeds and recipes may be shared out in
    any way. Writes results.json, .md, .csv, .tex and report.html (without pictures) to the folder given by --out.

    Args:
        records: Records of compare, ablate or bench (results.json), or folders with one.
        out: Folder to write.
        against: One of the recipes: tables have the difference of every other one to it.
    """
    join_tables = importlib.import_module("polarguide.experiments.join").join_tables
    print_results(join_tables(records, out, against=against), out)
