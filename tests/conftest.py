"""For all tests: the demo scene; and one thread for torch, because tensors are small here."""

from pathlib import Path

import pytest
import torch
from tiny import make_busy_recipe, make_scene

import polarguide
from polarguide.capture import Scene
from polarguide.cli.app import run
from polarguide.training.recipe import Recipe

torch.set_num_threads(1)

STEPS = 40
SHORT = ("--downscale", "4", "--steps", str(STEPS), "--threads", "1")


@pytest.fixture(scope="session")
def demo_scene() -> Path:
    """The folder of the scene that ships with the package."""
    return Path(polarguide.__file__).parent / "data" / "demo"


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


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    return make_scene()


@pytest.fixture
def busy_recipe() -> Recipe:
    return make_busy_recipe()
