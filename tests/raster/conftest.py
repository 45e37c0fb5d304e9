"""The rasterizer's tests run on each instruction set that this processor has."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from polarguide import _native


def instruction_sets() -> list[str]:
    """The variants that this processor can run."""
    names = []
    active = _native.simd()
    for name in ("baseline", "avx2", "avx512"):
        try:
            _native.select_simd(name)
        except ValueError:
            continue
        names.append(name)
    _native.select_simd(active)
    return names


@pytest.fixture(params=instruction_sets())
def simd(request: pytest.FixtureRequest) -> Iterator[str]:
    active = _native.simd()
    _native.select_simd(request.param)
    yield request.param
    _native.select_simd(active)
