"""The digest of the program changes with its code and with nothing else; the commit is its own."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from polarguide.results.evaluation.sources import COMMIT, code_digest, commit

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("optics/a.py", True),
        ("_native.so", True),
        ("new.py", True),
        ("_native.pyi", False),
        ("data/picture.png", False),
    ],
)
def test_code_counts_and_other_files_do_not(tmp_path: Path, name: str, counts: bool) -> None:
    for file in ("optics/a.py", "_native.so", "_native.pyi", "data/picture.png"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("first")
    code_digest.cache_clear()
    before = code_digest(tmp_path)
    (tmp_path / name).write_text("second")
    code_digest.cache_clear()
    assert (code_digest(tmp_path) != before) == counts
    assert len(before) == 16


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
