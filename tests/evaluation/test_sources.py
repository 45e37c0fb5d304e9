"""The digests of the program's code change with what it does, and with nothing else; the commit is its own."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from polarguide.evaluation.sources import (
    COMMIT,
    PACKAGE,
    SCORED_BY,
    TRAINED_BY,
    commit,
    digest_of,
    imported_files,
    scoring_digest,
    training_digest,
)

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("_native", "gone.py", "optics/a.py")


@pytest.fixture
def package(tmp_path: Path) -> Path:
    (tmp_path / "optics").mkdir()
    (tmp_path / "optics" / "a.py").write_text(
        '"""About."""\n\ndef f(x):\n    """F."""\n    return x + 1  # one\n'
    )
    (tmp_path / "_native.so").write_bytes(b"\x7fELF 1")
    (tmp_path / "_native.pyi").write_text("def f(): ...")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "text"),
    [("optics/a.py", "def f(x):\n    return x + 2\n"), ("_native.so", "\x7fELF 2"), ("gone.py", "")],
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


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("import ours.optics.a", ["optics/__init__.py", "optics/a.py"]),
        ("import ours.optics.a as x, os", ["optics/__init__.py", "optics/a.py"]),
        ("from ours.optics import a", ["optics/__init__.py", "optics/a.py"]),
        ("from ours.optics.a import f", ["optics/__init__.py", "optics/a.py"]),
        ("from ours import optics", ["optics/__init__.py"]),
        ("from ..optics import a", ["optics/__init__.py", "optics/a.py"]),
        ("from . import other", ["training/other.py", "vectors.py"]),
        ("from .other import f", ["training/other.py", "vectors.py"]),
        ("def f():\n    from ours.vectors import g", ["vectors.py"]),
        ("def f():\n    return importlib.import_module('ours.vectors')", ["vectors.py"]),
        ("from ours import __version__, _native", ["_native"]),
        ("import ours._native", ["_native"]),
        (
            "if TYPE_CHECKING:\n    from ours import vectors\nelse:\n    import ours.optics",
            ["optics/__init__.py"],
        ),
        ("import ours\nimport torch, yours.vectors", []),
        ("from ours.recipes import named", ["vectors.py"]),
        ("import ours.circle", ["circle.py"]),
    ],
)
def test_imports_are_followed(tmp_path: Path, text: str, found: list[str]) -> None:
    package = tmp_path / "ours"
    for name, content in {
        "__init__.py": "import ours.vectors",
        "optics/__init__.py": "",
        "optics/a.py": "",
        "vectors.py": "",
        "circle.py": "import ours.training.trainer",
        "recipes/__init__.py": "import ours.vectors",
        "training/__init__.py": "",
        "training/other.py": "import ours.vectors",
        "training/trainer.py": text,
    }.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(content)
    own = {"training/trainer.py", "training/__init__.py"}
    assert set(imported_files(package, ("training/trainer.py",))) - own == set(found)


def test_what_is_loaded_with_the_trainer_is_found() -> None:
    names = [part.removesuffix(".py").replace("/", ".") for part in TRAINED_BY + SCORED_BY]
    code = f"import sys, {', '.join('polarguide.' + name for name in names)}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    found = set(imported_files(PACKAGE, TRAINED_BY + SCORED_BY))
    missed = []
    for name in loaded.stdout.split():
        first, *steps = name.split(".")
        path = "/".join(steps)
        is_module = not (PACKAGE / path).is_dir() or (PACKAGE / path / "__init__.py").exists()
        if first == "polarguide" and steps and steps[0] != "recipes" and is_module:
            missed += [] if found & {path, f"{path}.py", f"{path}/__init__.py"} else [name]
    assert missed == []


def test_the_files_that_train_and_score() -> None:
    trained = imported_files(PACKAGE, TRAINED_BY)
    for name in (
        "_native",
        "optics/separation.py",
        "gaussians/densify.py",
        "raster/cuda.py",
        "capture/view.py",
    ):
        assert name in trained
    assert not [
        name for name in trained if name.split("/")[0] in ("recipes", "viewer", "evaluation", "synth")
    ]
    scored = imported_files(PACKAGE, TRAINED_BY + SCORED_BY)
    assert set(scored) > set(trained)
    assert {"evaluation/metrics.py", "evaluation/table.py", "runs/opened.py"} <= set(scored)
    assert len({training_digest(), scoring_digest()}) == 2
    assert len(training_digest()) == 16


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
