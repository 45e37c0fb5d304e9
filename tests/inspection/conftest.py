"""Fixtures of the inspection tests."""

from __future__ import annotations

import pytest
from glossy_ball import views_around

from polarguide.inspection.capture import InspectedView


@pytest.fixture(scope="session")
def ball_views() -> tuple[InspectedView, ...]:
    """Views of a glossy ball. Tests leave them as they are."""
    return views_around()
