"""Reporters are silent by default."""

from __future__ import annotations

import pytest

from polarguide.core.progress import SILENT


def test_the_default_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    SILENT.say("a")
    SILENT.warn("b")
    with SILENT.track("c", None) as advance:
        advance(1, total=2, note="d")
    assert capsys.readouterr() == ("", "")
