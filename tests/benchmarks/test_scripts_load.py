"""Every program in ``benchmarks`` still finds what it imports."""

import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
BLENDER = {"blender_draw.py"}
"""Programs that run inside Blender."""
LOAD = """
import runpy, sys
path = list(sys.path)
for program in sys.argv[1:]:
    sys.path[:] = [program.rpartition("/")[0], *path]
    try:
        runpy.run_path(program, run_name="benchmark")
    except ImportError as error:
        print(f"{program}: {error}")
"""


def test_every_benchmark_finds_its_imports() -> None:
    programs = sorted(str(path) for path in BENCHMARKS.glob("*/*.py") if path.name not in BLENDER)
    assert len(programs) > 30
    found = subprocess.run(
        [sys.executable, "-c", LOAD, *programs], capture_output=True, text=True, check=True
    )
    assert found.stdout == ""
