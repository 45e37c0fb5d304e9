"""Every kernel test runs with each instruction set that this processor has."""

from collections.abc import Iterator

import pytest

from polarguide import _native


def _available() -> list[str]:
    names = []
    for name in ("baseline", "avx2", "avx512"):
        try:
            _native.select_simd(name)
        except ValueError:
            continue
        names.append(name)
    _native.select_simd("auto")
    return names


@pytest.fixture(params=_available())
def simd(request: pytest.FixtureRequest) -> Iterator[str]:
    """The instruction set in use during the test."""
    _native.select_simd(request.param)
    yield request.param
    _native.select_simd("auto")


@pytest.fixture(autouse=True)
def default_threads() -> Iterator[None]:
    yield
    _native.set_thread_count(0)
