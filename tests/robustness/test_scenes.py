"""Spoiled scenes end as their tables say."""

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("table", ["scenes", "pictures", "truths"])
def test_every_case_ends_as_its_table_says(table, run_table):
    assert run_table(table) == []
