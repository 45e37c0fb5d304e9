"""The digest of the program changes with its code and with nothing else; the commit is its own."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from polarguide.results.evaluation.sources import COMMIT, NOT_TRAINING, code_digest, commit

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("name", "text", "changes"),
    [
        ("optics/a.py", "second = 2", (True, True)),
        ("optics/a.py", '"""Other words."""\nfirst = 1  # and a comment', (False, False)),
        ("results/a.py", "second = 2", (True, False)),
        ("_native.so", "second", (True, True)),
        ("new.py", "", (True, True)),
        ("_native.pyi", "second", (False, False)),
        ("data/picture.png", "second", (False, False)),
    ],
)
def test_code_counts_and_scoring_repeats_no_training(
    tmp_path: Path, name: str, text: str, changes: tuple[bool, bool]
) -> None:
    for file in ("optics/a.py", "results/a.py", "_native.so", "_native.pyi", "data/picture.png"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("first = 1")

    def digests() -> list[str]:
        code_digest.cache_clear()
        return [code_digest(tmp_path, training=training) for training in (False, True)]

    before = digests()
    (tmp_path / name).write_text(text)
    assert tuple(now != then for now, then in zip(digests(), before, strict=True)) == changes
    assert {len(digest) for digest in before} == {16}


def test_a_training_reaches_none_of_the_rooms_that_its_digest_leaves_out() -> None:
    left_out = {f"polarguide.{name.removesuffix('.py')}" for name in NOT_TRAINING}
    code = "import sys, polarguide.runs.train; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "polarguide.training.trainer" in loaded.split()
    assert not {".".join(name.split(".")[:2]) for name in loaded.split()} & left_out


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=n", "-c", "user.email=e@example.org")
    return subprocess.run(
        ["git", *who, "-C", str(folder), *words], capture_output=True, text=True, check=True
    ).stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> tuple[Path, str]:
    """A repository with one commit: its folder and the hash."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    top = tmp_path / "checkout"
    top.mkdir()
    git(top, "init", "-q")
    git(top, "commit", "-q", "--allow-empty", "-m", "first")
    return top, git(top, "rev-parse", "HEAD")


def test_a_checkout_reports_its_commit_and_nobody_elses(repository: tuple[Path, str]) -> None:
    top, head = repository
    own, installed = top / "src" / "polarguide", top / ".venv" / "site-packages" / "polarguide"
    own.mkdir(parents=True)
    installed.mkdir(parents=True)
    assert commit(own) == head
    assert commit(installed) is None
    (installed / COMMIT).write_text("0123abc\n")
    assert commit(installed) == "0123abc"
    (own / COMMIT).write_text("\n")
    assert commit(own) is None
    shutil.rmtree(top / ".git")
    (own / COMMIT).unlink()
    assert commit(own) is None


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="cmake is not on the path")
@pytest.mark.parametrize("place", ["", "their/vendored"])
def test_the_build_stamps_its_commit_and_nobody_elses(
    repository: tuple[Path, str], tmp_path: Path, place: str
) -> None:
    top, head = repository
    shutil.copytree(ROOT / "native", top / place / "native")
    shutil.copy(ROOT / "CMakeLists.txt", top / place)
    build = tmp_path / "build"
    command = ["cmake", "-S", str(top / place), "-B", str(build), "-DPOLARGUIDE_BINDINGS=OFF"]
    subprocess.run(command, capture_output=True, text=True, check=True)
    assert (build / COMMIT).read_text() == ("\n" if place else f"{head}\n")
