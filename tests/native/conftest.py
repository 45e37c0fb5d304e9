"""Every kernel test runs with each instruction set that this processor has."""

from collections.abc import Iterator

import pytest
from instruction_sets import instruction_sets, selected

from polarguide import _native


@pytest.fixture(params=instruction_sets())
def simd(request: pytest.FixtureRequest) -> Iterator[str]:
    """The instruction set in use during the test."""
    with selected(request.param) as name:
        yield name


@pytest.fixture(autouse=True)
def default_threads() -> Iterator[None]:
    yield
    _native.set_thread_count(0)
