"""A scene small enough to train on in a test, and a recipe in which everything happens: see ``tiny.py``."""

from __future__ import annotations

import pytest
from tiny import make_busy_recipe, make_scene

from polarguide.capture import Scene
from polarguide.training.recipe import Recipe


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    return make_scene()


@pytest.fixture
def busy_recipe() -> Recipe:
    return make_busy_recipe()
