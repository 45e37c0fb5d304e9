"""The Dockerfile copies all files that the build needs, and the image runs the program as an ordinary user."""

import re
from pathlib import Path

import pytest

tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib -> use Python 3.11")

ROOT = Path(__file__).resolve().parents[2]
LINES = (ROOT / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def instructions(name: str) -> list[str]:
    """The arguments of each instruction of a name."""
    return [line.removeprefix(name).strip() for line in LINES if line.startswith(f"{name} ")]


def copied() -> set[str]:
    """The paths that the build stage copies from the checkout."""
    copies = [line.split() for line in instructions("COPY") if not line.startswith("--from")]
    return {source for *sources, _ in copies for source in sources}


def needed() -> set[str]:
    """The paths that ``pip install .`` reads."""
    cmake = (ROOT / "CMakeLists.txt").read_text()
    roots = set(re.findall(r"\b([a-z_]+)/[a-z_]+\.cpp", cmake))
    packages = {path.split("/")[0] for path in PROJECT["tool"]["scikit-build"]["wheel"]["packages"]}
    project = PROJECT["project"]
    files = {"pyproject.toml", "CMakeLists.txt", project["readme"], *project["license-files"]}
    return files | roots | packages


def test_all_files_of_the_build_are_copied() -> None:
    assert needed() >= {"native", "src", "LICENSE", "README.md"}
    assert copied() == needed()
    assert all((ROOT / path).exists() for path in copied())


def test_the_build_has_a_compiler_and_a_supported_python() -> None:
    versions = [re.fullmatch(r"python:3\.(\d+)-slim(?: AS \w+)?", base) for base in instructions("FROM")]
    minors = {int(match[1]) for match in versions if match}
    assert len(versions) == 2
    assert len(minors) == 1  # The environment is copied, so both stages need the same interpreter.
    least = PROJECT["project"]["requires-python"].removeprefix(">=3.")
    assert min(minors) >= int(least)
    build = " ".join(instructions("RUN"))
    assert {"g++", "--torch-backend=cpu"} <= set(build.split())


def test_the_image_runs_the_program_as_an_ordinary_user() -> None:
    users = instructions("USER")
    assert len(users) == 1
    assert users[0] not in ("root", "0")
    assert any(f"useradd --create-home {users[0]}" in line for line in instructions("RUN"))
    program = re.fullmatch(r'\["(/opt/\w+)/bin/(\w+)"\]', instructions("ENTRYPOINT")[0])
    assert program
    assert program[2] in PROJECT["project"]["scripts"]
    assert f"COPY --from=build {program[1]} {program[1]}" in LINES


def test_compiled_files_of_this_machine_stay_outside() -> None:
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    assert {"**/*.so", "**/__pycache__"} <= set(ignored)
