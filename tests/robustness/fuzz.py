"""``make fuzz N=``: all cases of all tables, with N seeds of each that is random; prints what failed, and how to repeat it.

python tests/robustness/fuzz.py [--tables NAME ...] [--seeds N] [--first SEED] [--only TEXT] [--ci] [--say]

With ``--serve`` it reads names of tables from its input, and writes a line of JSON for each: what ``make test`` starts.
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
from dataclasses import dataclass, field
from pathlib import Path

from warm import warm_up  # it puts the helpers on the path

from base import make_base  # isort: skip
from case import Case, seeded  # isort: skip
from forked import MOST_HANGS, Outcome, adopt, outcomes, run  # isort: skip
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


@dataclass
class Report:
    """What came out: outcomes by kind, faults in words, the most that a case took."""

    kinds: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    seconds: float = 0.0
    mebibytes: float = 0.0

    def add(self, kind: str, fault: str) -> None:
        """Count an outcome; ``fault``: what was wrong, or nothing."""
        self.kinds[kind] += 1
        self.faults += [fault] if fault else []
        if self.kinds["hang"] == MOST_HANGS and kind == "hang":
            self.faults.append(f"after {MOST_HANGS} cases that hang, the rest of the table was not run")


class Corpus:
    """A process that has imported everything, and the base that it has made."""

    def __init__(self, folder: Path) -> None:
        self.mounts = own_mounts()
        warm_up()
        adopt()
        self.folder, self.base = folder, folder / "base"
        made = run(lambda: make_base(self.base), folder / "said")
        assert made.status == 0, f"the base could not be made: {made.text}"

    def outcomes(self, name: str, *, ci: bool, first: int = 0, rounds: int = 1, only: str = "") -> Iterator[Outcome]:
        """Outcomes of the cases of a table."""
        chosen = [case for case in table(name) if (case.ci or not ci) and only in case.name]
        if ci:  # one seed of each
            yield from outcomes(chosen, self.base, self.folder / "work")
        else:
            yield from outcomes(seeded(chosen, first, rounds), self.base, self.folder / "work")

    def report(self, name: str, *, say: bool = False, ci: bool = False, only: str = "", **seeds: int) -> Report:
        """Run a table, or full disks."""
        report = Report()
        if name == DISKS:
            for command, wrong in full_disks(self.base, self.folder / "disk", ci, only) if self.mounts else ():
                report.add("wrong" if wrong else "right", "\n".join([f"fault: {command}", *wrong]) if wrong else "")
                print(command, "wrong" if wrong else "right", file=sys.stderr)
            return report
        for outcome in self.outcomes(name, ci=ci, only=only, **seeds):
            report.add(outcome.kind, str(outcome) if outcome.is_fault else "")
            report.seconds = max(report.seconds, outcome.seconds)
            report.mebibytes = max(report.mebibytes, outcome.mebibytes)
            if say:
                print(f"--- {outcome}", flush=True)
        return report


def serve(corpus: Corpus, answers: int) -> None:
    """Answer names of tables, until there are no more."""
    for line in sys.stdin:
        report = corpus.report(line.strip(), ci=True)
        answer = {"count": report.kinds.total(), "mounts": corpus.mounts, "faults": report.faults}
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
    with tempfile.TemporaryDirectory() as folder:
        corpus = Corpus(Path(folder))
        if asked.serve:
            serve(corpus, answers)
            return 0
        failed = 0
        for name in asked.tables:
            seeds = {"first": asked.first, "rounds": asked.seeds}
            report = corpus.report(name, say=asked.say, ci=asked.ci, only=asked.only, **seeds)
            print("\n".join([f"--- {fault}" for fault in report.faults]), end="\n" * bool(report.faults))
            most = f"at most {report.seconds:.1f} s and {report.mebibytes:.0f} MiB"
            print(f"{name}: {report.kinds.total()} cases: {dict(report.kinds)}; {most}", flush=True)
            failed += len(report.faults)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
