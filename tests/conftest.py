"""For all tests: the demo scene; and one thread for torch, because tensors are small here."""

from pathlib import Path

import pytest
import torch

import polarguide

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def demo_scene() -> Path:
    """The folder of the scene that ships with the package."""
    return Path(polarguide.__file__).parent / "data" / "demo"
