"""The verb ``doctor``."""

from __future__ import annotations

import importlib
import json as json_text
import os
import platform
import re
import shlex
import shutil
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.table import Column, Table

import polarguide
from polarguide.cli.console import console, say, warn
from polarguide.core.errors import install_extra, install_package, requirements
from polarguide.core.system import free_memory

EXTRAS = {
    "cuda": "train and render on an NVIDIA GPU",
    "lpips": "the metric lpips",
    "heic": "HEIC photographs",
    "usd": "USDZ packages (export --format usdz, splat-usdz)",
    "cluster": "compare, ablate, bench and batch on SLURM or PBS",
    "synth": "synth and bench: scenes with ground truth",
}
"""Purposes of the extras for users; docs and test are for developers of polarguide."""
_CUDA_LIBRARY = re.compile(r"(nvidia|cuda)[-_]|triton$")
"""Names of the distributions that PyTorch for CUDA depends on."""
GIB = float(1 << 30)


def doctor(*, json: bool = False) -> int:
    """Print what is installed, what computes here, and what is missing, with the command that installs it.

    The exit status is 1 if a package that every command needs is missing or cannot be loaded. Attach the output to
    the
    report of a problem: it contains folders of this machine, but nothing of your captures.

    Args:
        json: Print one JSON object instead of text.
    """
    report = diagnosis()
    if json:
        print(json_text.dumps(report, indent=2))
    else:
        _print(report)
    return 1 if report["problems"] else 0


def diagnosis() -> dict[str, Any]:
    """Return the state of this installation as plain values for JSON.

    Returns:
        ``polarguide`` and ``python``: versions. ``packages``: versions by name, None for a package that is not
        installed. ``kernels`` and ``torch``: their properties, or ``error`` alone if they cannot be loaded.
        ``extras``: optional packages. ``machine``: processor, memory and disk. ``problems``: faults that make
        commands fail. ``notes``: other faults.
    """
    packages = {
        each.name: _version(each.name)
        for each in requirements()
        if not each.extra and not (each.conditional and _version(each.name) is None)
    }
    problems = [f"{name} is not installed: {install_package(name)}" for name, v in packages.items() if not v]
    torch = _torch()
    kernels = _kernels()
    for name, state in (("torch", torch), ("polarguide's kernels", kernels)):
        if "error" in state:
            problems.append(f"{name} cannot be loaded: {state['error']}")
    offered = {each.extra for each in requirements()}
    extras = {name: _extra(name, use) for name, use in EXTRAS.items() if name in offered}
    return {
        "polarguide": {"version": polarguide.__version__, "folder": str(Path(polarguide.__file__).parent)},
        "python": {"version": platform.python_version(), "executable": sys.executable},
        "packages": packages,
        "kernels": kernels,
        "torch": torch,
        "extras": extras,
        "machine": {
            "system": platform.platform(),
            "processor": platform.machine(),
            "cores": os.cpu_count(),
            "free_memory_gib": round(free_memory() / GIB, 1),
            "free_disk_gib": round(shutil.disk_usage(Path.cwd()).free / GIB, 1),
        },
        "problems": problems,
        "notes": _notes(torch, extras),
    }


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _kernels() -> dict[str, Any]:
    """Return the instruction set and the number of threads of our kernels."""
    try:
        native = importlib.import_module("polarguide._native")
    except Exception as error:  # loaders of different systems raise different errors
        return {"error": _line(error)}
    return {"instruction_set": native.simd(), "threads": native.thread_count(), "file": native.__file__}


def _torch() -> dict[str, Any]:
    """Return PyTorch's threads, its CUDA version, and the usable GPUs."""
    try:
        torch = importlib.import_module("torch")
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        properties = [torch.cuda.get_device_properties(number) for number in range(count)]
    except Exception as error:  # loaders of different systems raise different errors
        return {"error": _line(error)}
    gpus = [{"name": each.name, "memory_gib": round(each.total_memory / GIB, 1)} for each in properties]
    return {
        "version": torch.__version__,
        "threads": torch.get_num_threads(),
        "cuda": torch.version.cuda,
        "gpus": gpus,
    }


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def _extra(name: str, use: str) -> dict[str, Any]:
    """Return installed and missing packages of an extra, and the command that installs the missing ones, or None."""
    wanted = [each for each in requirements() if each.extra == name]
    missing = [each.name for each in wanted if _version(each.name) is None]
    return {
        "use": use,
        "installed": {each.name: _version(each.name) for each in wanted if each.name not in missing},
        "missing": missing,
        "command": install_extra(name) if missing else None,
    }


def _notes(torch: dict[str, Any], extras: dict[str, Any]) -> list[str]:
    """Return faults that do not make commands fail."""
    if not extras:
        return ["polarguide is not installed here, so that its packages cannot be checked: pip install ."]
    if torch.get("gpus") and extras["cuda"]["missing"]:
        return [f"There is a GPU, but trainings run on the CPU without gsplat: {extras['cuda']['command']}"]
    if torch.get("gpus"):
        return []
    if shutil.which("nvidia-smi") is not None:
        built = torch.get("cuda") or "no CUDA"
        return [f"There is an NVIDIA driver, but PyTorch (built for {built}) can use no GPU."]
    return [_useless_cuda(torch["cuda"])] if torch.get("cuda") else []


def _useless_cuda(version: str) -> str:
    """Return a note about PyTorch for CUDA on a machine without a GPU.

    The note states the size of the libraries and the commands that replace them.
    """
    libraries = {
        name: sum((file.size or 0) for file in each.files or ())
        for each in metadata.distributions()
        if _CUDA_LIBRARY.match(name := each.metadata["Name"])
    }
    remove = shlex.join(["pip", "uninstall", "-y", "torch", *sorted(libraries)])
    return (
        f"PyTorch is built for CUDA {version}, but there is no GPU: the CUDA libraries take "
        f"{sum(libraries.values()) / 1e9:.1f} GB. The build for processors is sufficient: {remove}; "
        "pip install uv; uv pip install --torch-backend=cpu torch"
    )


def _print(report: dict[str, Any]) -> None:
    kernels = report["kernels"]
    torch = report["torch"]
    machine = report["machine"]
    table = Table("", Column(overflow="fold"), box=None, show_header=False, pad_edge=False)
    rows = {
        "polarguide": f"{report['polarguide']['version']}  {report['polarguide']['folder']}",
        "Python": f"{report['python']['version']}  {report['python']['executable']}",
        "system": f"{machine['system']}, {machine['cores']} cores",
        "free memory": f"{machine['free_memory_gib']} GiB",
        "free disk": f"{machine['free_disk_gib']} GiB in this folder",
    }
    if "error" not in kernels:
        rows["kernels"] = f"{kernels['instruction_set']}, threads: {kernels['threads']}"
    if "error" not in torch:
        rows["PyTorch"] = f"{torch['version']}, threads: {torch['threads']}"
        gpus = [f"{each['name']} ({each['memory_gib']} GiB)" for each in torch["gpus"]]
        rows["GPU"] = ", ".join(gpus) or "none"
    rows["packages"] = ", ".join(
        f"{name} {version}" for name, version in report["packages"].items() if version
    )
    for name, extra in report["extras"].items():
        state = extra["command"] or ", ".join(f"{each} {v}" for each, v in extra["installed"].items())
        installed = "missing" if extra["missing"] else "installed"
        rows[f"extra {name}"] = f"{installed} ({extra['use']}): {state}"
    for row in rows.items():
        table.add_row(*row)
    console.print(table, markup=False, soft_wrap=False)
    for note in report["notes"]:
        say(note)
    for problem in report["problems"]:
        warn(problem)
    if not report["problems"]:
        say("nothing is missing that every command needs")
