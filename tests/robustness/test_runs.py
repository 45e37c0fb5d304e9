"""Cases of spoiled runs end in an error of one line, in a warning, or pass for a reason that the table names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("table", ["runs", "records", "names"])
def test_every_case_ends_as_the_table_says(table: str, run_table: Callable[[str], dict[str, Any]]) -> None:
    answer = run_table(table)
    assert answer["faults"] == []
    assert answer["count"] > 0
