# ruff: noqa: E501
"""``make soak``: commands are killed at random moments and repeated until they end; then their files are compared.

python tests/robustness/soak.py [--kills N] [--seed SEED] [--without TEXT]

Trainings of every recipe, preparations, exports, pages and comparisons. The killed command runs in a fork of this process,
so that the moments fall into its work and not into its start. What it ends with has to have the same bytes as that of a command
which nobody disturbed, and nothing half-written may be left beside it.
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

from base import MOSAICS, make_base  # isort: skip

RECIPES = ("polarguide-stokes", "polarguide", "polarguide-paper", "3dgs", "3dgs-dr", "ref-gs")
STEPS = "12"
VARYING = (
    ".lock",
    "log.jsonl",
    "results.json",
    "results.md",
    "results.csv",
    "results.tex",
    "report.html",
    "stderr.txt",
    "metrics.json",
    "inputs.json",
)
"""Files with times in them, or without content."""

Command = Callable[[Path], list[str]]


def train(recipe: str) -> Command:
    """A training into ``out``, gone on with where it has begun."""

    def arguments(out: Path) -> list[str]:
        more = ["--resume"] if (out / "run.json").exists() else []
        flags = ["--steps", STEPS, "--checkpoint-every", "3", "--threads", "1", "--device", "cpu"]
        return ["train", "scene", "--out", str(out), "--recipe", recipe, *flags, *more]

    return arguments


COMMANDS: dict[str, Command] = {
    **{f"train {recipe}": train(recipe) for recipe in RECIPES},
    "prepare": lambda out: [*MOSAICS[:3], str(out), *MOSAICS[4:]],
    **{
        f"export {kind}": lambda out, kind=kind: ["export", "run", "--format", kind, "--out", str(out), "--threads", "1"]
        for kind in ("ply", "sog", "spz", "cameras", "environment")
    },
    "share": lambda out: ["share", "run", "--out", str(out / "page.html"), "--threads", "1"],
    "compare": lambda out: [
        "compare", "scene", "--recipes", "3dgs",
        "polarguide", "--steps", STEPS, "--out", str(out), "--report-views", "0"
    ],
}  # fmt: skip


def begin(arguments: list[str]) -> int:
    """Run a command line in a fork; returns its process."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    code = 99
    with contextlib.suppress(BaseException):
        nowhere = os.open("/dev/null" if not os.environ.get("SOAK_SAY") else "/dev/stderr", os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = importlib.import_module("polarguide.cli.app").run(arguments)
    os._exit(code)


def ended(pid: int) -> int:
    """Wait for a process; its exit status."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def digests(out: Path) -> dict[str, str]:
    """SHA-256 of every file whose content is the same each time."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name not in VARYING
    }


def soak(kills: int, seed: int, without: str = "") -> Counter[str]:
    """Kill; returns how many kills of each kind, and of faults."""
    rng = random.Random(seed)
    counts: Counter[str] = Counter()
    expected: dict[str, tuple[dict[str, str], float]] = {}
    names = [name for name in COMMANDS if not without or without not in name]
    while sum(count for name, count in counts.items() if name in COMMANDS) < kills:
        name = names[counts.total() % len(names)] if counts.total() < len(names) else rng.choice(names)
        command = COMMANDS[name]
        if name not in expected:
            out = Path("whole") / name.replace(" ", "-")
            began = time.monotonic()
            status = ended(begin(command(out)))
            if status:
                print(f"FAULT {name}: ends with {status} though nobody disturbed it", flush=True)
                counts["fault"] += 1
                names.remove(name)
                continue
            expected[name] = digests(out), time.monotonic() - began
        whole, seconds = expected[name]
        out = Path("killed")
        shutil.rmtree(out, ignore_errors=True)
        for _ in range(rng.randint(1, 3)):
            pid = begin(command(out))
            time.sleep(rng.uniform(0, 1.05 * seconds))
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            if ended(pid) != -signal.SIGKILL:
                break
            counts[name] += 1
        if name == "compare":
            time.sleep(1)  # its children hold the lock until they have ended
        status = None
        for _ in range(60):
            if (out / "run.json").exists() and name.startswith("train") and digests(out) == whole:
                status = 0
                break
            status = ended(begin(command(out)))
            if status == 0 or name != "compare":
                break
            time.sleep(2)
        found = digests(out)
        wrong = sorted(key for key in whole.keys() | found.keys() if whole.get(key) != found.get(key))
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
        make_base(Path(folder) / "base")
        os.chdir(Path(folder) / "base")
        counts = soak(asked.kills, asked.seed, asked.without)
    print(f"{counts.total() - counts['fault']} kills, {counts['fault']} faults: {dict(counts)}")
    return int(counts["fault"] > 0)


if __name__ == "__main__":
    sys.exit(main())
