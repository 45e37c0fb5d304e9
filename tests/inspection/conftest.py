"""Fixtures of the inspection tests."""

from __future__ import annotations

import pytest
from glossy_ball import views_around

from polarguide.inspection.pictures import Pictures


@pytest.fixture(scope="session")
def ball_views() -> tuple[Pictures, ...]:
    """Views of a glossy ball. Tests leave them as they are."""
    return views_around()
