"""Every page that we write says what it may do: a name in a stranger's file that became markup could do nothing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import polarguide
from polarguide.visualization.pages import content_policy

PAGES = sorted(Path(polarguide.__file__).parent.rglob("*.html"))


def test_there_are_pages() -> None:
    assert {page.stem for page in PAGES} >= {"report", "page", "inspection", "shot", "base"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_the_policy_before_anything_else(page: Path) -> None:
    text = page.read_text("utf-8")
    if page.stem != "base":
        assert text.startswith('{% extends "base.html" %}\n')
        assert "<head>" not in text
        return
    policy = text.index('<meta http-equiv="Content-Security-Policy" content="{{ policy|safe }}">')
    assert not re.search(r"<(script|style|link|body|img)|{% block", text[:policy])


@pytest.mark.parametrize("script", ["", "let x = 1;"])
def test_the_policy_asks_for_nothing(script: str) -> None:
    rules = dict(rule.strip().partition(" ")[::2] for rule in content_policy(script).split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["base-uri"] == rules["form-action"] == "'none'"
    assert re.fullmatch(r"'sha256-[A-Za-z0-9+/]{43}='" if script else "", rules.get("script-src", ""))
    assert not re.search(r"https?:|\*|unsafe-eval", content_policy(script)), "nothing comes from elsewhere"
