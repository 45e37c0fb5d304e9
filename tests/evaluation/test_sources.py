"""The digests of the program's code change with what it does, and with nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from polarguide.evaluation.sources import PACKAGE, SCORED_BY, TRAINED_BY, digest_of, training_digest

# What decides no number of a run: names and messages, recipes (a run knows all values of its own), other outputs.
WITHOUT_PART = {
    "__init__.py",
    "__main__.py",
    "errors.py",
    "recipes",
    "export",
    "data",
    "inspection",
    "viewer",
    "synth",
    "api.py",
    "surroundings.py",
    "trajectory.py",
}


@pytest.fixture
def package(tmp_path: Path) -> Path:
    (tmp_path / "optics").mkdir()
    (tmp_path / "optics" / "a.py").write_text(
        '"""About."""\n\ndef f(x):\n    """F."""\n    return x + 1  # one\n'
    )
    (tmp_path / "_native.so").write_bytes(b"\x7fELF 1")
    (tmp_path / "_native.pyi").write_text("def f(): ...")
    return tmp_path


PARTS = ("_native", "optics", "gone.py")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("optics/a.py", "def f(x):\n    return x + 2\n"),
        ("optics/b.py", "y = 1\n"),
        ("_native.so", "\x7fELF 2"),
        ("gone.py", ""),
    ],
)
def test_code_counts(package: Path, name: str, text: str) -> None:
    before = digest_of(package, PARTS)
    (package / name).write_text(text)
    assert digest_of(package, PARTS) != before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("optics/a.py", '"""Better words."""\n# Why.\ndef f(x):\n\n    return (x + 1)\n'),
        ("_native.pyi", "def f() -> int: ..."),
        ("other.py", "z = 1"),
    ],
)
def test_words_and_other_files_do_not(package: Path, name: str, text: str) -> None:
    before = digest_of(package, PARTS)
    (package / name).write_text(text)
    assert digest_of(package, PARTS) == before


def test_every_part_of_the_package_is_judged() -> None:
    known = {part.split("/")[0] for part in TRAINED_BY + SCORED_BY} | WITHOUT_PART | {"cli", "evaluation"}
    found = {
        path.name for path in PACKAGE.iterdir() if path.suffix in ("", ".py") and path.name != "__pycache__"
    }
    assert found - known == set()


def test_every_part_that_is_named_exists() -> None:
    for part in TRAINED_BY + SCORED_BY:
        assert part == "_native" or (PACKAGE / part).exists(), part
    assert len(training_digest()) == 16
