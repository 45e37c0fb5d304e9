"""Numbers in texts that people write."""

from __future__ import annotations

import math

import pytest

from polarguide.core.text import decimal


@pytest.mark.parametrize(
    ("text", "value"), [("1.5", 1.5), (" -3e2 ", -300.0), ("inf", math.inf), ("007", 7.0)]
)
def test_numbers(text: str, value: float) -> None:
    assert decimal(text) == value


@pytest.mark.parametrize("text", ["1_0", "4_5.0", "\u0664\u0665", "\uff11", "", "a", "0x10"])
def test_what_python_alone_takes_for_a_number_is_none(text: str) -> None:
    with pytest.raises(ValueError, match=r"not a number|could not convert"):
        decimal(text)
