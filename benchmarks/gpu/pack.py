"""Collect the scenes and wheels that ``make gpu-check`` needs on a machine without a network, in one folder.

Run ``python benchmarks/gpu/pack.py --scene SCENES/spheres --python 3.12`` here. Then copy the repository with the
folder ``gpu-pack`` to the machine with the GPU, and run ``make gpu-check`` there.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from importlib import resources
from pathlib import Path

from packed import SUFFIX, save_scene

from polarguide.capture import load_scene

# Packages that a machine with torch, numpy and nvcc may lack, including their dependencies.
WHEELS = (
    "gsplat==1.5.3",
    "jaxtyping",
    "wadler-lindig",
    "rich",
    "markdown-it-py",
    "mdurl",
    "pygments",
    "ninja",
    "packaging",
    "safetensors",
    "plyfile",
    "msgspec",
    "nanobind",
    "nanobind-backend",
    "scikit-build-core",
    "pathspec",
    "pytest",
    "iniconfig",
    "pluggy",
    "tyro",
    "docstring-parser",
    "typeguard",
    "typing-extensions",
    "shtab",
)
LARGE = ("cmake", "scipy", "opencv-python-headless", "numpy")
PLATFORMS = (
    "manylinux_2_28_x86_64",
    "manylinux_2_27_x86_64",
    "manylinux_2_17_x86_64",
    "manylinux2014_x86_64",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("gpu-pack"))
    parser.add_argument("--scene", type=Path, help="the capture `spheres`")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--python", default="3.12", help="of the machine with the GPU")
    parser.add_argument("--large", action="store_true", help=f"also {', '.join(LARGE)}")
    parser.add_argument("--no-wheels", action="store_true")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with resources.as_file(resources.files("polarguide") / "data" / "demo") as demo:
        save_scene(load_scene(demo), arguments.out / f"demo{SUFFIX}")
    if arguments.scene:
        spheres = load_scene(arguments.scene, downscale=arguments.downscale)
        save_scene(spheres, arguments.out / f"spheres{SUFFIX}")
    if not arguments.no_wheels:
        download(arguments.out / "wheels", arguments.python, WHEELS + (LARGE if arguments.large else ()))
    for path in sorted(arguments.out.rglob("*")):
        if path.is_file():
            print(f"{path.stat().st_size / 2**20:7.1f} MiB  {path}")


def download(folder: Path, python: str, wheels: tuple[str, ...]) -> None:
    """Download the wheels for another machine's Python with pip."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary=:all:", "--implementation", "cp", "--python-version", python]
    for platform in PLATFORMS:
        command += ["--platform", platform]
    subprocess.run([*command, "--dest", str(folder), *wheels], check=True)


if __name__ == "__main__":
    main()
