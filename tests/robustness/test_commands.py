"""Descriptions, options, places and processes that are wrong end as their tables say."""

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("table", ["synthesis", "options", "places", "processes"])
def test_every_case_ends_as_its_table_says(table, run_table):
    assert run_table(table) == []
