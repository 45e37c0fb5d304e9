"""``make wheel``: build the wheel, and use it as somebody does who has no compiler.

Builds and repairs it, installs it into a new environment whose PATH has nothing else, runs the demo there, and the
kernels without PyTorch under every other Python on this machine. Run with an environment that has auditwheel.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLATFORM = f"manylinux_2_28_{platform.machine()}"
NAMES = [f"python3.{minor}" for minor in range(10, 20)]
COMPILERS = ("cc", "c++", "gcc", "g++", "clang", "clang++", "cmake", "ninja", "make")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "wheel", help="made anew")
    parser.add_argument("--steps", type=int, help="of the demo, in place of its own number")
    arguments = parser.parse_args()
    shutil.rmtree(arguments.work, ignore_errors=True)
    arguments.work.mkdir(parents=True)
    wheel = build(arguments.work, arguments.out)
    print(f"{wheel.name}: {wheel.stat().st_size / 2**20:.1f} MiB")
    bare = environment(Path(sys.executable), arguments.work / "bare")
    constraints = ["-c", str(ROOT / "constraints-cpu.txt")]
    torch = next(
        line for line in (ROOT / "constraints-cpu.txt").read_text().split() if line.startswith("torch==")
    )
    timed("PyTorch", *pip(bare, *constraints, torch), folder=bare)
    timed("polarguide and the rest", *pip(bare, *constraints, str(wheel)), folder=bare)
    size = sum(
        path.stat().st_size for path in (bare / "lib").rglob("*") if path.is_file() and not path.is_symlink()
    )
    print(f"the environment takes {size / 2**20:,.0f} MiB", flush=True)
    steps = [] if arguments.steps is None else ["--steps", str(arguments.steps)]
    demo = [str(bare / "bin" / "polarguide"), "demo", "--out", str(arguments.work / "demo"), *steps]
    timed("the demo", *demo, folder=bare)
    digests = {kernels(bare)}
    for python in other_pythons():
        folder = environment(python, arguments.work / f"python-{python.parent.parent.name}-{python.name}")
        run(*pip(folder, "numpy", "nanobind-backend"), folder=folder)
        run(*pip(folder, "--no-deps", str(wheel)), folder=folder)
        digests.add(kernels(folder))
    if len(digests) > 1:
        sys.exit("kernels: expected the same values under every Python, found several")


def build(work: Path, out: Path) -> Path:
    """Build the wheel, and have auditwheel check its symbols and name it; returns its path."""
    begin = time.monotonic()
    wheels = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*wheels, "--wheel-dir", str(work / "built"), str(ROOT)], check=True)
    built = next((work / "built").glob("*.whl"))
    programs = {**os.environ, "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}
    repair = ["auditwheel", "repair", "--plat", PLATFORM, "--wheel-dir", str(work / "repaired"), str(built)]
    subprocess.run(repair, check=True, env=programs)
    repaired = next((work / "repaired").glob("*.whl"))
    print(f"built and repaired in {time.monotonic() - begin:.0f} s", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copy2(repaired, out))


def environment(python: Path, folder: Path) -> Path:
    """A new environment without packages; returns its folder."""
    subprocess.run([str(python), "-m", "venv", str(folder)], check=True)
    path = str(folder / "bin")
    compilers = [name for name in COMPILERS if shutil.which(name, path=path)]
    if compilers:
        sys.exit(f"{path}: expected no compiler, found {', '.join(compilers)}")
    return folder


def pip(folder: Path, *arguments: str) -> list[str]:
    """The command that installs into an environment; nothing may be compiled on the way."""
    install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--only-binary=:all:"]
    return [str(folder / "bin" / "python"), *install, *arguments]


def run(*command: str, folder: Path) -> str:
    """Run a command that finds only the programs of an environment; returns what it prints."""
    alone = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "CC", "CXX")}
    alone |= {"PATH": str(folder / "bin"), "VIRTUAL_ENV": str(folder)}
    done = subprocess.run(command, env=alone, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        sys.exit(f"{done.stdout}\n{' '.join(command)}: exit status {done.returncode}")
    return done.stdout


def timed(what: str, *command: str, folder: Path) -> None:
    """Run a command, print what it prints, and how long it took."""
    print(f"{what} ...", flush=True)
    begin = time.monotonic()
    print(run(*command, folder=folder), end="")
    print(f"{what}: {time.monotonic() - begin:.0f} s", flush=True)


def kernels(folder: Path) -> str:
    """Run the kernels under an environment's Python; returns the digest of what they compute."""
    line = run(str(folder / "bin" / "python"), str(Path(__file__).with_name("kernels.py")), folder=folder)
    print(line, end="", flush=True)
    return line.rpartition(": ")[2].strip()


def other_pythons() -> list[Path]:
    """Pythons from 3.10 on the PATH and of pyenv, one of every minor version other than this one."""
    on_path = [Path(place) for name in NAMES if (place := shutil.which(name)) is not None]
    of_pyenv = sorted((Path.home() / ".pyenv" / "versions").glob("3.*/bin/python3"))
    by_version: dict[str, Path] = {}
    for python in (*of_pyenv, *on_path):
        asked = [str(python), "-c", "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"]
        done = subprocess.run(asked, capture_output=True, text=True, check=False)
        version = done.stdout.strip()
        if not done.returncode and re.fullmatch(r"3\.[1-9]\d", version):
            by_version.setdefault(version, python)
    by_version.pop(f"{sys.version_info[0]}.{sys.version_info[1]}", None)
    print(f"other Pythons: {', '.join(by_version) or 'none'}", flush=True)
    return list(by_version.values())


if __name__ == "__main__":
    main()
