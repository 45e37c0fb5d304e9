"""Check of the built site: no page, style sheet or script requests a file from another host.

Links that a reader clicks may lead to other sites. Files that a browser loads by itself have to be part of the site.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

HOST = re.compile(r"\s*(?:(?:https?|wss?|ftp):)?//", re.IGNORECASE)
"""Start of an address on another host."""
LOADED = ("src", "poster", "data", "background", "xlink:href")
"""Attributes whose files a browser loads without a click."""
LINKED = {
    "stylesheet",
    "icon",
    "preload",
    "prefetch",
    "preconnect",
    "dns-prefetch",
    "modulepreload",
    "manifest",
}
"""Relations of a ``link`` element whose files a browser loads."""
STYLE = re.compile(r"""(?:@import\s+(?:url\()?|url\()\s*["']?([^"')\s;]+)""", re.IGNORECASE)
"""Address in a style sheet."""
REQUEST = re.compile(
    r"""\b(?:(?:fetch|import|importScripts|open|sendBeacon|Worker|WebSocket|EventSource)\s*\(|from|import)\s*"""
    r"""(?:["'`]\w{0,7}["'`]\s*,\s*)?["'`]([^"'`]+)"""
)
"""Literal address in a request or import of a script. The second line skips the method of ``XMLHttpRequest.open``."""


class LoadedFiles(HTMLParser):
    """Addresses that a browser loads for a page, in ``addresses``."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.element = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the addresses in the attributes of an element."""
        self.element = tag
        values = {name: value or "" for name, value in attrs}
        self.addresses += [values[name] for name in LOADED if name in values]
        self.addresses += re.split(r",\s+", values.get("srcset", ""))
        self.addresses += STYLE.findall(values.get("style", ""))
        loads = tag == "link" and LINKED & {*values.get("rel", "").lower().split()}
        if loads or tag in ("base", "image", "use"):
            self.addresses.append(values.get("href", ""))

    def handle_data(self, data: str) -> None:
        """Collect the addresses in style sheets and scripts of the page."""
        if self.element in ("style", "script"):
            self.addresses += loaded_by(data, f".{self.element}")

    def handle_endtag(self, tag: str) -> None:
        """Leave a style sheet or a script."""
        self.element = ""


def loaded_by(text: str, suffix: str) -> list[str]:
    """Return the addresses that a browser loads for a file with this text and suffix."""
    if suffix in (".css", ".style"):
        return STYLE.findall(text)
    if suffix in (".js", ".script"):
        return REQUEST.findall(text)
    page = LoadedFiles()
    page.feed(text)
    return page.addresses


def requests_elsewhere(site: Path) -> Iterator[str]:
    """Yield a line for each file of another host that the pages, style sheets and scripts in a folder load."""
    for path in sorted(site.rglob("*")):
        if path.suffix in (".html", ".svg", ".css", ".js"):
            for address in loaded_by(path.read_text(encoding="utf-8"), path.suffix):
                if HOST.match(address):
                    yield f"{path.relative_to(site)}: {address[:200]}"


def check_site(app: Sphinx, error: Exception | None) -> None:
    """Stop the build if a built page loads a file from another host.

    Raises:
        ValueError: a page loads such a file.
    """
    if error is None and app.builder.format == "html":
        lines = [*requests_elsewhere(Path(app.outdir))]
        if lines:
            raise ValueError("expected a site without files of other hosts, found\n" + "\n".join(lines))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the check."""
    app.connect("build-finished", check_site)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
