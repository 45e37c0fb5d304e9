"""For the rendering tests: Mitsuba with LLVM, or a reason to skip."""

import pytest
from started_mitsuba import started_mitsuba


@pytest.fixture(scope="session")
def mitsuba() -> None:
    """Start Mitsuba."""
    started_mitsuba()
