"""Compare time to quality: a training of another checkout with a shorter training of this one, pair by pair.

    python benchmarks/speed/quality.py --before CHECKOUT --scenes SCENE... [--seeds 0 1 2] [--steps 5000] [--now 4000]
        [--recipe polarguide-stokes] [--threads 1] [--out FOLDER]

Both train and score in their own processes, one after the other, each with its own code (``CHECKOUT/src``, with its
native module built there). Seconds are those of the training in its log, including priors. Scored runs are not
repeated, so the command can resume. Run it without other work on the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]
SCORES = {
    "psnr": "PSNR",
    "psnr_foreground": "foreground",
    "normal_mae_deg": "degrees",
    "specular_psnr": "specular",
    "diffuse_psnr": "diffuse",
}


def command(checkout: Path, *words: object) -> None:
    environment = {**os.environ, "PYTHONPATH": str(checkout / "src")}
    begin = (
        "import sys; sys.path[:] = [p for p in sys.path if p]; from polarguide.__main__ import main; main()"
    )
    subprocess.run([sys.executable, "-c", begin, *map(str, words)], env=environment, check=True)


def trained(
    checkout: Path, scene: Path, out: Path, steps: int, seed: int, options: argparse.Namespace
) -> dict[str, float]:
    """Return scores and seconds of a run, which is trained if it is missing."""
    if not (out / "metrics.json").exists():
        shared = "--recipe", options.recipe, "--steps", steps, "--seed", seed, "--threads", options.threads
        resumed = ("--resume",) if (out / "run.json").exists() else ()
        command(checkout, "train", scene.resolve(), "--out", out, *shared, *resumed)
        command(checkout, "eval", out, "--threads", options.threads)
    found: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    last = (out / "log.jsonl").read_text().strip().splitlines()[-1]
    mean = found.get("mean", found)
    return {**{name: float(mean[name]) for name in SCORES}, "seconds": float(json.loads(last)["seconds"])}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, nargs="+", required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--now", type=int, default=4000)
    parser.add_argument("--recipe", default="polarguide-stokes")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("time-to-quality"))
    options = parser.parse_args()
    out = options.out.resolve()
    rows = []
    for seed in options.seeds:
        for scene in options.scenes:
            name = f"{scene.name}-{seed}"
            before = trained(
                options.before.resolve(), scene, out / f"before-{name}", options.steps, seed, options
            )
            now = trained(HERE, scene, out / f"now-{name}", options.now, seed, options)
            rows.append((name, before, now))
    print("| scene, seed | seconds | share of time | " + " | ".join(SCORES.values()) + " |")
    print("|" + "---|" * (3 + len(SCORES)))
    for name, before, now in rows:
        share = now["seconds"] / before["seconds"]
        scores = " | ".join(f"{before[s]:.2f}, {now[s]:.2f}" for s in SCORES)
        print(f"| {name} | {before['seconds']:.0f}, {now['seconds']:.0f} | {share:.2f} | {scores} |")
    means = {s: statistics.mean(now[s] - before[s] for _, before, now in rows) for s in SCORES}
    share = statistics.mean(now["seconds"] / before["seconds"] for _, before, now in rows)
    print(f"| mean difference | | {share:.2f} | " + " | ".join(f"{means[s]:+.2f}" for s in SCORES) + " |")


if __name__ == "__main__":
    main()
