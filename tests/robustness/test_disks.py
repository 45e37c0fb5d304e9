"""Commands that write, on a disk that is full."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_nothing_is_lost(run_table: Callable[[str], dict[str, Any]]) -> None:
    answer = run_table("full_disk")
    if not answer["mounts"]:
        pytest.skip("only root, or who may have namespaces of users, can mount a small disk")
    assert answer["faults"] == []
    assert answer["count"] > 0
