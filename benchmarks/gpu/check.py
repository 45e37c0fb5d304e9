"""``make gpu-check``: build, tests, benchmarks and a full training on a GPU, in parts that can resume.

Needs python3 with torch, nvcc with a C++ compiler, and the folder of ``pack.py``. Each call does missing parts until
its time is up (``--minutes``), lists the remaining ones, and writes a table and one JSON of all results. This script
uses only the standard library, and each part has its own process.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PARTS = (
    "build",
    "tests",
    "train-demo",
    "train-spheres",
    "bench-demo",
    "bench-spheres",
    "bench-stress",
    "train-long",
)
# Minimum time of a part. Only the first build takes as long.
LONGEST_SECONDS = 460.0
# Packages of the parts besides torch. Wheels of the pack replace missing ones.
MODULES = ("numpy", "scipy", "safetensors", "plyfile", "msgspec", "cv2", "rich", "pytest", "tyro", "ninja")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pack", type=Path, default=ROOT / "gpu-pack")
    parser.add_argument("--out", type=Path, default=ROOT / "gpu-check")
    parser.add_argument(
        "--results", type=Path, default=None, help="the JSON; benchmarks/records/gpu-NAME.json"
    )
    parser.add_argument("--minutes", type=float, default=7.5, help="of this call")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument(
        "--tiny", action="store_true", help="a dry run: tiny sizes, for a machine without a GPU"
    )
    arguments = parser.parse_args()
    deadline = time.monotonic() + 60 * arguments.minutes
    arguments.out.mkdir(parents=True, exist_ok=True)
    environment = provide(arguments.pack, arguments.out)
    failed = ""
    for part in PARTS:
        if read(arguments.out, part).get("finished"):
            continue
        left = deadline - time.monotonic()
        if left < (5 if arguments.tiny else 45):
            break
        print(f"{part} ...", flush=True)
        begin = time.monotonic()
        if not run_part(part, arguments, environment, min(left, LONGEST_SECONDS)):
            failed = part
            break
        print(f"{part}: {time.monotonic() - begin:.0f} s", flush=True)
        if not read(arguments.out, part).get("finished"):
            break
    results = {part: read(arguments.out, part) for part in PARTS}
    path = arguments.results or ROOT / "benchmarks" / "records" / f"gpu-{machine(results)}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results))
    missing = [part for part in PARTS if not results[part].get("finished")]
    print(f"\nwritten: {path}")
    if failed:
        sys.exit(f"{failed} failed (see above); the next call tries it again. Missing: {', '.join(missing)}")
    print(f"still missing: {', '.join(missing)}; call again to resume" if missing else "complete")


def read(out: Path, part: str) -> dict[str, Any]:
    """Return the result of a part; {} without one."""
    path = out / f"{part}.json"
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return found


def machine(results: dict[str, dict[str, Any]]) -> str:
    """Return a file name for the device."""
    device = str(results["build"].get("device", "unknown"))
    return "".join(c if c.isalnum() else "-" for c in device.lower()).strip("-")


def provide(pack: Path, out: Path) -> dict[str, str]:
    """Return the environment of the parts: our source with its kernels, and the pack's wheels of missing packages.

    An installed polarguide with kernels replaces a source without kernels.
    """
    site = out / "site"
    if not pack.is_dir():
        sys.exit(
            f"{pack}: expected the folder that benchmarks/gpu/pack.py makes, found nothing; see docs/how-to/gpu.md"
        )
    paths = [str(site), *(path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path)]
    as_installed = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), *paths])}
    wheels = [str(wheel) for wheel in sorted((pack / "wheels").glob("*.whl")) if not installed(wheel)]
    if wheels and not site.is_dir():
        pip("--target", str(site), *wheels)
    lacking = [
        name for name in MODULES if importlib.util.find_spec(name) is None and not any(site.glob(f"{name}*"))
    ]
    if lacking:
        print(f"not installed, and no wheel in the pack: {', '.join(lacking)}", flush=True)
    probe = [sys.executable, "-c", "import polarguide._native"]
    for found in (environment, as_installed):
        if not subprocess.run(probe, env=found, cwd=out, capture_output=True, check=False).returncode:
            return found
    build_native(environment, out)
    return environment


def installed(wheel: Path) -> bool:
    """Return True if the machine has the package of a wheel, in any version."""
    try:
        importlib.metadata.version(wheel.name.split("-")[0].replace("_", "-"))
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def pip(*arguments: str) -> None:
    """Install without a network."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--upgrade"]
    subprocess.run([*command, "--disable-pip-version-check", *arguments], check=True)


def build_native(environment: dict[str, str], out: Path) -> None:
    """Compile the CPU kernels for this Python, next to our source."""
    print("compiling polarguide's own kernels ...", flush=True)
    built = out / "native"
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-index",
        "--no-deps",
        "--no-build-isolation",
    ]
    command += ["--disable-pip-version-check", "--wheel-dir", str(built), str(ROOT)]
    if subprocess.run(command, env=environment, check=False).returncode:
        sys.exit(
            "polarguide's kernels: needs cmake, a C++17 compiler, nanobind and scikit-build-core; see above"
        )
    unpacked = built / "unpacked"
    shutil.unpack_archive(str(next(built.glob("polarguide-*.whl"))), unpacked, "zip")
    for stale in (ROOT / "src" / "polarguide").glob(
        "_native*.so"
    ):  # kernels of one Python version take precedence
        stale.unlink()
    for library in (unpacked / "polarguide").glob("_native*.so"):
        shutil.copy2(library, ROOT / "src" / "polarguide")


def run_part(part: str, arguments: argparse.Namespace, environment: dict[str, str], seconds: float) -> bool:
    """Run one part in its own process, and return True for success."""
    if part == "tests":
        return run_tests(arguments, environment)
    command = [sys.executable, str(HERE / "parts.py"), part, "--pack", str(arguments.pack)]
    command += [
        "--out",
        str(arguments.out),
        "--device",
        arguments.device,
        "--seconds",
        str(max(5.0, seconds - 30)),
    ]
    command += ["--tiny"] if arguments.tiny else []
    return subprocess.run(command, env=environment, check=False).returncode == 0


def run_tests(arguments: argparse.Namespace, environment: dict[str, str]) -> bool:
    """Run the tests that need a GPU. Without a GPU they are skipped with a message."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-W", "default"]
    # Listed by file, because the other tests import packages that a bare machine does not have.
    command += sorted(map(str, (ROOT / "tests").glob("*/test_*_on_gpu.py")))
    done = subprocess.run(
        command,
        env=environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    print(done.stdout[-3000:] + done.stderr[-1000:], flush=True)
    last = [line for line in done.stdout.splitlines() if line.strip()][-1:]
    found = {"finished": done.returncode == 0, "closing_line": " ".join(last)}
    (arguments.out / "tests.json").write_text(json.dumps(found, indent=1) + "\n")
    return done.returncode == 0


ROWS = (
    ("forward, ms", "forward_ms"),
    ("forward and backward, ms", "forward_backward_ms"),
    ("training step, ms", "step_ms"),
    ("final picture, frames a second", "fps"),
    ("all layers, frames a second", "fps_layers"),
    ("peak memory, MiB", "peak_mib"),
)


RATIOS = (("our step over plain", "step_ratio"), ("our frames over plain", "fps_ratio"))


def table(results: dict[str, dict[str, Any]]) -> str:
    """Return one table of all benchmarks as Markdown."""
    benches = [
        (part, results[part]) for part in PARTS if part.startswith("bench") and results[part].get("ours")
    ]
    names = [
        f"{part[6:]} {found['size'][0]}x{found['size'][1]}, {found['gaussians']:,}" for part, found in benches
    ]
    lines = ["", f"device: {results['build'].get('device', 'not known yet')}", ""]
    if benches:
        lines.append("| | " + " | ".join(f"{name}: ours | plain gsplat" for name in names) + " |")
        lines.append("|---|" + "---|" * (2 * len(benches)))
    for label, key in ROWS if benches else ():
        cells = [number((found[side] or {}).get(key)) for _, found in benches for side in ("ours", "plain")]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    for label, key in RATIOS if benches else ():
        cells = [cell for _, found in benches for cell in (number(found.get(key)), "")]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    if benches:
        shares = [cell for _, found in benches for cell in (number(found["ours"]["outside"]), "")]
        lines.append("| share outside rasterizer, SSIM, optimizer | " + " | ".join(shares) + " |")
    for part in ("train-demo", "train-spheres", "train-long"):
        if found := results[part]:
            progress = f"{found['steps']:,} of {found['of']:,} steps in {found['minutes']:.1f} minutes"
            lines.append(
                f"\n{part}: {progress}, {found['gaussians']:,} Gaussians, PSNR {number(found['psnr'])} dB"
            )
    return "\n".join(lines)


def number(value: float | None) -> str:
    """Format a number with about three digits."""
    return "n/a" if value is None else f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    main()
