"""The rasterizer's tests run on each instruction set that this processor has."""

from collections.abc import Iterator

import pytest
from instruction_sets import instruction_sets, selected


@pytest.fixture(params=instruction_sets())
def simd(request: pytest.FixtureRequest) -> Iterator[str]:
    with selected(request.param) as name:
        yield name
