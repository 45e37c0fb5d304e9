"""``make fuzz N=``: all cases of all tables, random ones with N seeds; prints what failed, and how to repeat it.

python tests/robustness/fuzz.py [--tables NAME ...] [--seeds N] [--first SEED] [--only TEXT] [--ci] [--say]

With ``--serve`` it reads names of tables from its input, and answers with a line of JSON each: ``make test`` does so.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from warm import warm_up  # it puts the helpers on the path

from base import make_base  # isort: skip
from case import Case, seeded  # isort: skip
from forked import MOST_HANGS, adopt, outcomes, run  # isort: skip
from full_disk import full_disks, own_mounts  # isort: skip

DISKS = "full_disk"
TABLES = ("scenes", "pictures", "truths", "models", "poses", "raw", "measurement", "calibration", "runs", "records",
          "synthesis", "options", "places", "names", "processes")  # fmt: skip


def table(name: str) -> list[Case]:
    """The cases of a table, whose names differ."""
    cases: list[Case] = importlib.import_module(name).CASES
    counts = Counter(case.name for case in cases)
    assert len(counts) == len(cases), [name for name, count in counts.items() if count > 1]
    return cases


class Corpus:
    """A process that has imported everything, and the base that it has made."""

    def __init__(self, folder: Path, asked: argparse.Namespace) -> None:
        self.asked, self.folder, self.base = asked, folder, folder / "base"
        self.mounts = own_mounts()
        warm_up()
        adopt()
        made = run(lambda: make_base(self.base), folder / "said")
        assert made.status == 0, f"the base could not be made: {made.text}"

    def results(self, name: str) -> Iterator[tuple[str, bool, str]]:
        """Of every case of a table that is asked for: how it ended, whether that is a fault, and what it printed."""
        asked = self.asked
        if name == DISKS:
            for case, wrong in full_disks(self.base, self.folder / "disk", asked) if self.mounts else ():
                yield "wrong" if wrong else "right", bool(wrong), f"{case}\n" + "\n".join(wrong)
            return
        chosen = [case for case in table(name) if (case.ci or not asked.ci) and asked.only in case.name]
        cases = chosen if asked.ci else seeded(chosen, asked.first, asked.seeds)
        for outcome in outcomes(cases, self.base, self.folder / "work"):
            yield outcome.kind, outcome.is_fault, str(outcome)

    def report(self, name: str) -> tuple[Counter[str], list[str]]:
        """Results of a table by kind, and its faults."""
        kinds: Counter[str] = Counter()
        faults = []
        for kind, is_fault, text in self.results(name):
            kinds[kind] += 1
            faults += [text] if is_fault else []
            if self.asked.say:
                print(f"--- {text}", flush=True)
        if kinds["hang"] >= MOST_HANGS:
            faults.append(f"after {MOST_HANGS} cases that hang, the rest of the table was not run")
        return kinds, faults


def serve(corpus: Corpus, answers: int) -> None:
    """Answer names of tables, until there are no more."""
    for line in sys.stdin:
        kinds, faults = corpus.report(line.strip())
        answer = {"count": kinds.total(), "mounts": corpus.mounts, "faults": faults}
        os.write(answers, json.dumps(answer).encode() + b"\n")


def main() -> int:
    """Run; returns 1 where something failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tables", nargs="+", default=[*TABLES, DISKS], choices=[*TABLES, DISKS])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--ci", action="store_true", help="only what make test runs")
    parser.add_argument("--say", action="store_true", help="print every outcome")
    parser.add_argument("--serve", action="store_true")
    asked = parser.parse_args()
    answers = os.dup(1)
    if asked.serve:
        os.dup2(2, 1)  # what is printed is no answer
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        corpus = Corpus(Path(folder), asked)
        if asked.serve:
            serve(corpus, answers)
            return 0
        for name in asked.tables:
            kinds, faults = corpus.report(name)
            print("".join(f"--- {fault}\n" for fault in faults) + f"{name}: {dict(kinds)}", flush=True)
            failed |= bool(faults)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
