"""Fixtures of the preparation tests."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_capture import TinyCapture, write_tiny_capture


@pytest.fixture
def capture(tmp_path: Path) -> TinyCapture:
    """A valid capture in a folder of its own, for a test to damage."""
    return write_tiny_capture(tmp_path / "tiny")
