"""``polarguide doctor``: what is installed and what is missing, for people and as JSON."""

import json
import shutil
import sys
from importlib import metadata
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from polarguide import _native
from polarguide.cli.app import run
from polarguide.cli.doctor import EXTRAS
from polarguide.core.errors import install_extra

METADATA = [
    "torch>=2.4",
    "numpy>=1.26",
    "flip-evaluator>=1.6; python_version < '3.0'",
    "gsplat>=1.5.3; extra == 'cuda'",
    "numpy; extra == 'lpips'",
    "no-such-package==1.*; python_version >= '3' and extra == 'synth'",
    "pillow-heif>=0.18; extra == 'heic'",
    "usd-core; extra == 'usd'",
    "dask-jobqueue>=0.9; extra == 'cluster'",
    "furo; extra == 'docs'",
]


@pytest.fixture
def installation(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The requirements of an installation, which tests may add to."""
    lines = list(METADATA)
    versions = {"torch": "2.9", "numpy": "2.0"}

    def version(name: str) -> str:
        if name not in versions:
            raise metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(metadata, "requires", lambda _: lines)
    monkeypatch.setattr(metadata, "version", version)
    return lines


def doctor(capsys: pytest.CaptureFixture[str], status: int) -> dict[str, Any]:
    assert run(["doctor", "--json"]) == status
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


def test_versions_kernels_and_extras(installation: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Of a package that only some systems need, its absence is no problem; docs is no extra of users."""
    report = doctor(capsys, 0)
    assert report["packages"] == {"torch": "2.9", "numpy": "2.0"}
    assert report["python"]["executable"] == sys.executable
    assert report["kernels"] == {
        "instruction_set": _native.simd(),
        "threads": _native.thread_count(),
        "file": _native.__file__,
    }
    assert report["extras"].keys() == EXTRAS.keys()
    assert report["extras"]["lpips"]["installed"] == {"numpy": "2.0"}
    assert report["extras"]["lpips"]["command"] is None
    assert report["extras"]["synth"]["missing"] == ["no-such-package"]
    assert report["extras"]["synth"]["command"] == install_extra("synth")
    assert report["machine"]["free_disk_gib"] > 0
    assert report["problems"] == []


@pytest.mark.parametrize(
    ("broken", "named"),
    [("scipy>=1.10", "scipy is not installed"), ("torch", "torch"), ("polarguide._native", "kernels")],
)
def test_what_every_command_needs_is_a_problem(
    broken: str,
    named: str,
    installation: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A package that is missing, and a library that cannot be loaded: the report is whole, but for it."""
    if ">" in broken:
        installation.append(broken)
    else:
        monkeypatch.setitem(sys.modules, broken, None)
    (problem,) = doctor(capsys, 1)["problems"]
    assert named in problem
    assert run(["doctor"]) == 1
    assert named in " ".join(capsys.readouterr().out.split())


def test_the_text_names_what_is_missing_and_the_command(
    installation: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a terminal of 80 columns, where lines are wrapped; with brackets, which are no markup."""
    assert run(["doctor"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert install_extra("synth") in text
    assert _native.simd() in text


class Distribution:
    """An installed one, of one file."""

    def __init__(self, name: str, size: int) -> None:
        self.metadata, self.files = {"Name": name}, [SimpleNamespace(size=size)]


def test_a_build_for_cuda_without_a_gpu_is_named_with_its_size(
    installation: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed = [
        Distribution("nvidia-cublas", 3 * 10**9),
        Distribution("triton", 10**9),
        Distribution("numpy", 10**9),
    ]
    monkeypatch.setattr(metadata, "distributions", lambda: installed)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.setattr(torch.version, "cuda", None)
    assert doctor(capsys, 0)["notes"] == []
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    (note,) = doctor(capsys, 0)["notes"]
    assert "built for CUDA 13.0" in note
    assert "libraries take 4.0 GB" in note
    assert "pip uninstall -y torch nvidia-cublas triton; " in note
    assert "uv pip install --torch-backend=cpu torch" in note
    monkeypatch.setattr(shutil, "which", lambda _: "/usr/bin/nvidia-smi")
    (note,) = doctor(capsys, 0)["notes"]
    assert "There is an NVIDIA driver" in note


def test_without_metadata_it_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As from a checkout that is not installed: nothing can be said of packages."""
    monkeypatch.setattr(metadata, "requires", lambda _: None)
    report = doctor(capsys, 0)
    assert report["packages"] == report["extras"] == {}
    (note,) = report["notes"]
    assert "not installed" in note
