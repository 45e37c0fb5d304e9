"""Compare the peak resident memory of a training with its plan.

    python benchmarks/speed/memory.py SCENE [--downscale 4 2 1] [--memory 1TB 4GB] [--steps 24]

Each row is a process of ``polarguide train`` with the peak that the system reports at its end. With few steps there are
few Gaussians and unvisited views. Give 1.5 times as many steps as a training of the scene has views.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--downscale", type=int, nargs="+", default=[4, 2, 1])
    parser.add_argument("--memory", nargs="+", default=["1TB"], help="limits; 1TB keeps everything in memory")
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument("--recipe", default="polarguide-stokes")
    options = parser.parse_args()
    print("| downscale | --memory | peak GB | CPU s | system s |")
    print("|---|---|---|---|---|")
    for downscale in options.downscale:
        for memory in options.memory:
            with tempfile.TemporaryDirectory() as folder:
                command = [
                    sys.executable,
                    "-m",
                    "polarguide",
                    "train",
                    str(options.scene),
                    "--out",
                    f"{folder}/run",
                ]
                command += ["--steps", str(options.steps), "--downscale", str(downscale), "--memory", memory]
                command += ["--recipe", options.recipe]
                with open(f"{folder}/said", "w+", encoding="utf-8") as said:
                    child = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT)
                    _, status, used = os.wait4(child.pid, 0)
                    child.returncode = os.waitstatus_to_exitcode(status)
                    said.seek(0)
                    words = said.read().strip().splitlines()
            if child.returncode:
                print(f"| {downscale} | {memory} | {words[-1] if words else 'failed'} | | |", flush=True)
                continue
            peak = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9
            seconds = used.ru_utime + used.ru_stime
            print(
                f"| {downscale} | {memory} | {peak:.2f} | {seconds:.0f} | {used.ru_stime:.0f} |", flush=True
            )


if __name__ == "__main__":
    main()
