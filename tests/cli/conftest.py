"""A short training of the demo scene, by the command line, that many tests look at."""

from __future__ import annotations

from pathlib import Path

import pytest

from polarguide.cli.app import run

STEPS = 40
SHORT = ("--downscale", "4", "--steps", str(STEPS), "--threads", "1")


@pytest.fixture(scope="session")
def trained(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder. Tests read it and leave it as it is."""
    out = tmp_path_factory.mktemp("trained") / "run"
    assert run(["train", str(demo_scene), "--out", str(out), *SHORT]) == 0
    return out


@pytest.fixture(scope="session")
def short() -> tuple[str, ...]:
    """The flags with which ``trained`` was trained."""
    return SHORT
