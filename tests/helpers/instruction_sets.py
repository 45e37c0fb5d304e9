"""The variants of the kernels that this processor can run, and a test's choice among them."""

from collections.abc import Iterator
from contextlib import contextmanager

from polarguide import _native


def instruction_sets() -> list[str]:
    """Their names; the active one stays."""
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


@contextmanager
def selected(name: str) -> Iterator[str]:
    """One of them is active meanwhile."""
    active = _native.simd()
    _native.select_simd(name)
    yield name
    _native.select_simd(active)
