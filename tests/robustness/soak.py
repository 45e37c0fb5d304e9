"""``make soak``: commands are killed at random moments and repeated until they end; then their files are compared.

python tests/robustness/soak.py [--kills N] [--seed SEED] [--without TEXT]

The killed command runs in a fork of this process, so that the moments fall into its work and not into its start. What
it ends with has to have the same bytes as that of a command which nobody disturbed, and nothing half-written beside it.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from warm import warm_up  # it puts the helpers on the path

from base import FLAGS, MOSAICS, ONE, export, into, make_base  # isort: skip
from forked import Child, ended, run, start  # isort: skip

RECIPES = ("polarguide-stokes", "polarguide", "polarguide-paper", "3dgs", "3dgs-dr", "ref-gs")
STEPS = "--steps 12"
LONGEST = 600
"""Seconds for a command."""
REPEATED = 60
"""Times that a comparison is repeated while what it had started still holds the lock."""
VARYING = {
    ".lock", "log.jsonl", "results.json", "results.md", "results.csv", "results.tex", "report.html", "stderr.txt",
    "metrics.json", "inputs.json",
}  # fmt: skip
"""Files with times in them, or without content."""


def train(recipe: str) -> Callable[[str], str]:
    """A training, gone on with where it has begun."""

    def command(out: str) -> str:
        more = " --resume" if Path(out, "run.json").exists() else ""
        return f"train scene --out {out} --recipe {recipe} {STEPS} --checkpoint-every 3 {FLAGS}{more}"

    return command


COMMANDS: dict[str, Callable[[str], str]] = {
    **{f"train {recipe}": train(recipe) for recipe in RECIPES},
    "prepare": lambda out: into(out, MOSAICS),
    **{f"export {kind}": lambda out, kind=kind: into(out, export(kind))
       for kind in ("ply", "spz", "cameras", "normals", "environment")},
    "share": lambda out: f"share run --out {out}/page.html {ONE}",
    "compare": lambda out: f"compare scene --recipes 3dgs polarguide {STEPS} --out {out} --report-views 0",
}  # fmt: skip


def begin(command: str) -> Child:
    """Run a command line in a fork."""
    app = importlib.import_module("polarguide.cli.app")
    return start(lambda: app.run(command.split()), Path("../said"))


def status_of(child: Child) -> int:
    """Wait for a fork."""
    while (done := ended(child, LONGEST)) is None:
        time.sleep(0.005)
    return done.status


def digests(out: str) -> dict[str, str]:
    """SHA-256 of every file whose content is the same each time."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(Path(out).rglob("*"))
        if path.is_file() and path.name not in VARYING
    }


def killed(name: str, out: str, seconds: float, rng: random.Random) -> int:
    """Kill a command a few times, at moments of so many seconds; how often it was before it had ended."""
    most = rng.randint(1, 3)
    for count in range(most):
        child = begin(COMMANDS[name](out))
        time.sleep(rng.uniform(0, 1.05 * seconds))
        with contextlib.suppress(ProcessLookupError):
            os.kill(child.pid, signal.SIGKILL)
        if status_of(child) != -signal.SIGKILL:
            return count
    return most


def repeated(name: str, out: str) -> int:
    """Repeat a command until it ends: a comparison waits for what it had started, which holds the lock."""
    for _ in range(REPEATED):
        status = status_of(begin(COMMANDS[name](out)))
        if status == 0 or name != "compare":
            break
        time.sleep(1)
    return status


def soak(kills: int, seed: int, without: str) -> Counter[str]:
    """Kill; returns how many kills of each kind, and of faults."""
    rng = random.Random(seed)
    counts: Counter[str] = Counter()
    whole: dict[str, tuple[dict[str, str], float]] = {}
    for name in [name for name in COMMANDS if not without or without not in name]:
        out, began = f"whole/{name.replace(' ', '-')}", time.monotonic()
        status = status_of(begin(COMMANDS[name](out)))
        assert status == 0, f"{name} ends with {status} though nobody disturbed it"
        whole[name] = digests(out), time.monotonic() - began
    while counts.total() - counts["fault"] < kills:
        name = rng.choice(sorted(whole))
        expected, seconds = whole[name]
        shutil.rmtree("killed", ignore_errors=True)
        counts[name] += killed(name, "killed", seconds, rng)
        is_done = (
            name.startswith("train") and Path("killed/run.json").exists() and digests("killed") == expected
        )
        status = 0 if is_done else repeated(name, "killed")
        found = digests("killed")
        wrong = sorted(key for key in expected.keys() | found.keys() if expected.get(key) != found.get(key))
        if status or wrong:
            counts["fault"] += 1
            print(f"FAULT {name}: status {status}, other bytes in {wrong[:5]}", flush=True)
        print(f"{name}: {dict(counts)}", flush=True)
    return counts


def main() -> int:
    """Run; returns 1 where something failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--without", default="", help="leave out commands of this name; compare takes longest"
    )
    asked = parser.parse_args()
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        made = run(lambda: make_base(Path(folder) / "base"), Path(folder) / "said")
        assert made.status == 0, made.text
        os.chdir(Path(folder) / "base")
        counts = soak(asked.kills, asked.seed, asked.without)
    return int(counts["fault"] > 0)


if __name__ == "__main__":
    sys.exit(main())
