"""For the rendering tests: Mitsuba, or a reason to skip; and its variants, all paths compiled or one path at a time."""

from collections.abc import Iterator

import pytest

from polarguide_synth.settings import Variant, choose_variant


@pytest.fixture(scope="session", params=["compiled", "scalar"])
def variant(request: pytest.FixtureRequest) -> Iterator[Variant]:
    """Select a polarized variant, with and without LLVM."""
    pytest.importorskip("mitsuba", reason="no Mitsuba -> pip install '.[synth]'")
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "scalar":
            patch.setattr("polarguide_synth.settings.missing_llvm", lambda: "not wanted here")
        chosen = choose_variant("rgb", threads=1)
        if bool(chosen.note) != (request.param == "scalar"):
            pytest.skip("no LLVM for Mitsuba's compiled variants -> apt-get install libllvm19")
        yield chosen
