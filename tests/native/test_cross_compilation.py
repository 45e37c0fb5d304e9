"""The kernels compile for another processor family: nothing but the guarded variants is written for x86."""

import platform
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COMPILER = "aarch64-linux-gnu-g++"
ELF_MACHINE_AARCH64 = 183

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which(COMPILER) is None, reason=f"no {COMPILER} -> apt-get install g++-aarch64-linux-gnu"
    ),
    pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake -> apt-get install cmake"),
    pytest.mark.skipif(platform.machine() == "aarch64", reason="this machine is the target itself"),
]


def call(*command: object) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_the_kernels_compile_for_aarch64_without_warnings(tmp_path: Path) -> None:
    call(
        "cmake",
        "-S", ROOT,
        "-B", tmp_path,
        "-DPOLARGUIDE_BINDINGS=OFF",
        "-DCMAKE_SYSTEM_NAME=Linux",
        "-DCMAKE_SYSTEM_PROCESSOR=aarch64",
        f"-DCMAKE_CXX_COMPILER={COMPILER}",
        "-DCMAKE_CXX_FLAGS=-Werror",
        "-DPOLARGUIDE_OPTIMIZE=-O1",  # warnings that follow values need no more, and -O3 takes four times as long
    )  # fmt: skip
    call("cmake", "--build", tmp_path, "--target", "polarguide_core")
    objects = list(tmp_path.rglob("*.o"))
    names = {path.name.split(".")[0] for path in objects}
    assert {"raster_kernels", "raster_backward_kernels", "project_kernels", "rasterizer", "dispatch"} <= names
    for path in objects:
        machine = int.from_bytes(path.read_bytes()[18:20], "little")
        assert machine == ELF_MACHINE_AARCH64, path.name
    assert not [path for path in objects if "avx" in str(path.relative_to(tmp_path))]
