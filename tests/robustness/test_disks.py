"""Commands that write, on a disk that is full: one line, and nothing is lost."""

import pytest


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_nothing_is_lost(run_table):
    assert run_table("full_disk") == []
