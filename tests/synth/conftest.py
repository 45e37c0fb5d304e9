"""For the rendering tests: Mitsuba, or a reason to skip; and which of its variants can be used here."""

from __future__ import annotations

import pytest

from polarguide.synth.variant import Variant, choose_variant


@pytest.fixture(scope="session")
def variant() -> Variant:
    """The fastest polarized variant of this machine: compiled, or one path at a time where LLVM is missing."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed (pip install 'polarguide[synth]')")
    return choose_variant("rgb", threads=1)
