"""A Chromium of the system, driven by Playwright, where both are installed."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist"
)
# A stranger's name that points to this machine (DNS rebinding).
REBOUND = "rebound.example"
PATIENCE = 240  # seconds; software rendering on a busy machine is slow


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser with WebGL 2 by software; skips the test where there is none."""
    if CHROMIUM is None:
        pytest.skip("no Chromium -> apt-get install chromium")
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="no Playwright -> pip install '.[browser]'"
    )
    flags = [*FLAGS.split(), f"--host-resolver-rules=MAP {REBOUND} 127.0.0.1"]
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield browser
        browser.close()
