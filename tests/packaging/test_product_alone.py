"""The product without its three neighbors: its verbs work, and a verb of a neighbor says what is missing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

NEIGHBORS = ("polarguide_shots", "polarguide_synth", "polarguide_bench")
WITHOUT = f"""
from importlib.machinery import PathFinder

find = PathFinder.find_spec


def find_others(name, path=None, target=None):
    return None if name.partition(".")[0] in {NEIGHBORS!r} else find(name, path, target)


PathFinder.find_spec = staticmethod(find_others)
"""
"""A module that Python imports before anything else: the neighbors cannot be found any more."""
SHORT = ("--steps", "20", "--threads", "1")
SECONDS = 600.0


class Product:
    """Calls the command line without the neighbors, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        site = folder / "site"
        site.mkdir()
        (site / "sitecustomize.py").write_text(WITHOUT)
        self.environment = {**os.environ, "PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"}

    def __call__(self, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "polarguide", *words],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=SECONDS,
        )

    def python(self, code: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", code],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )


@pytest.fixture(scope="module")
def product(tmp_path_factory: pytest.TempPathFactory) -> Product:
    return Product(tmp_path_factory.mktemp("product"))


@pytest.mark.slow
def test_the_product_works_alone(product: Product, demo_scene: Path) -> None:
    run = "runs/own"
    for words in (
        (
            "prepare",
            str(demo_scene / "polar"),
            "--out",
            "scene",
            "--poses",
            str(demo_scene),
            "--threads",
            "1",
        ),
        ("train", "scene", "--out", run, "--downscale", "4", *SHORT),
        ("eval", run, "--no-speed", "--threads", "1"),
        ("render", run, "--threads", "1"),
        ("share", run, "--out", "page.html", "--threads", "1"),
        ("export", run, "--format", "ply", "--threads", "1"),
    ):
        done = product(*words)
        assert done.returncode == 0, f"{words}: {done.stdout[-2000:]} {done.stderr[-2000:]}"
    assert (product.folder / "page.html").stat().st_size > 10_000
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "polarguide", "view", run, "--threads", "1"],
        cwd=product.folder,
        env=product.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        address = next(line.split()[1] for line in process.stdout if line.startswith("viewer: "))
        with urllib.request.urlopen(address, timeout=SECONDS) as answer:
            assert b"<html" in answer.read().lower()
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=SECONDS)


@pytest.mark.parametrize(
    ("words", "package"),
    [
        (("measure", "parts", "--out", "table"), "polarguide_shots"),
        (("synth", "proof", "--out", "scene"), "polarguide_synth"),
        (("compare", "scene", "--recipes", "3dgs", "--out", "tables"), "polarguide_bench"),
    ],
)
def test_a_verb_of_a_neighbor_says_what_is_missing(
    product: Product, words: tuple[str, ...], package: str
) -> None:
    done = product(*words)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    said = " ".join(done.stderr.split())
    assert f"{words[0]}: expected the package {package}, a part of polarguide" in said


def test_the_reader_of_a_dataset_says_what_is_missing(product: Product, tmp_path: Path) -> None:
    for part in ("s0", "s1", "s2"):
        (tmp_path / "in" / part).mkdir(parents=True)
    done = product("prepare", str(tmp_path / "in"), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    said = " ".join(done.stderr.split())
    assert "in (dataset nersp): expected the package polarguide_bench, a part of polarguide" in said


def test_names_and_help_do_without_the_neighbors(product: Product) -> None:
    code = (
        "import polarguide\n"
        "try:\n    polarguide.compare\n"
        "except polarguide.PolarguideError as error:\n    print(error)\n"
        "print([*polarguide.recipes()][-1])"
    )
    done = product.python(code)
    assert done.stdout.splitlines()[0].startswith("compare: expected the package polarguide_bench"), (
        done.stderr
    )
    assert done.stdout.splitlines()[-1].endswith(":unpolarized")
    listed = product("--help")
    assert listed.returncode == 0
    assert "(not installed)" in listed.stdout
