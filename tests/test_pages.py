"""Every page that we write says what it may do: a name in a stranger's file that became markup could do nothing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import polarguide

PAGES = sorted(Path(polarguide.__file__).parent.rglob("*.html"))


def test_there_are_pages() -> None:
    assert {page.stem for page in PAGES} >= {"report", "page", "inspection"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_asks_for_nothing(page: Path) -> None:
    (policy,) = re.findall(
        r'http-equiv="Content-Security-Policy"\s+content="([^"]*)"', page.read_text("utf-8")
    )
    rules = dict(rule.strip().partition(" ")[::2] for rule in policy.split(";") if rule.strip())
    assert rules["default-src"] == "'none'"
    assert not re.search(r"https?:|\*", policy), "nothing comes from elsewhere"
    assert "'unsafe-eval'" not in policy
    assert "'unsafe-inline'" not in rules.get("script-src", "")
