"""``make fuzz N=``: the corpus with further seeds; prints what failed, and the seed that repeats it.

python tests/robustness/fuzz.py [--seeds N] [--first SEED] [--only TEXT]
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from warm import warm_up  # it puts the helpers on the path

from base import make_base  # isort: skip
from corpus import corpus  # isort: skip
from forked import Outcome, outcomes  # isort: skip
from named import named_cases  # isort: skip


def run(seeds: int = 1, first: int = 0, only: str = "", at_once: int = 2) -> Iterator[Outcome]:
    """Outcomes of the cases whose name contains a text."""
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        base, work = Path(folder) / "base", Path(folder) / "work"
        make_base(base)
        cases = itertools.chain(corpus(first, seeds), named_cases())
        yield from outcomes((c for c in cases if only in c.name), base, work, at_once)


def main() -> int:
    """Run; returns 1 where something failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--say", action="store_true", help="print every outcome")
    asked = parser.parse_args()
    kinds: Counter[str] = Counter()
    longest = largest = 0.0
    for outcome in run(asked.seeds, asked.first, asked.only):
        kinds[outcome.kind] += 1
        longest, largest = max(longest, outcome.seconds), max(largest, outcome.mebibytes)
        if outcome.is_fault or asked.say:
            figures = f"{outcome.seconds:.1f} s {outcome.mebibytes:.0f} MiB"
            print(f"--- {outcome.kind}: {outcome.case.name} (seed {outcome.case.seed}) {figures}")
            print(outcome.said.strip()[-700:])
    faults = sum(count for kind, count in kinds.items() if kind not in ("error", "warning", "accepted"))
    print(f"{sum(kinds.values())} cases: {dict(kinds)}; at most {longest:.1f} s and {largest:.0f} MiB")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
