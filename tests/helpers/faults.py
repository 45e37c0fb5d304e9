"""Errors of wrong input, compared field by field: no test depends on their sentences."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from polarguide.core.errors import PolarguideError


@dataclass(frozen=True)
class Fault:
    """Texts that the fields of an error have to contain; empty: anything."""

    where: str = ""
    expected: str = ""
    found: str = ""
    remedy: str = ""

    def raised_by(self, call: Callable[..., Any], *arguments: Any, **named: Any) -> PolarguideError:
        """Check that a call ends in an error of one line with these fields; returns it."""
        with pytest.raises(PolarguideError) as caught:
            call(*arguments, **named)
        assert "\n" not in str(caught.value)
        for name, text in vars(self).items():
            assert text in getattr(caught.value, name), f"{name}: {getattr(caught.value, name)}"
        return caught.value
