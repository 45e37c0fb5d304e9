"""Spoiled models, poses, raw files and measured shots end as their tables say."""

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("table", ["models", "poses", "raw", "measurement", "calibration"])
def test_every_case_ends_as_its_table_says(table, run_table):
    assert run_table(table) == []
