"""Installed packages that offer recipes or metrics, as far as ``importlib.metadata`` can tell."""

from pathlib import Path

import pytest


def install(
    monkeypatch: pytest.MonkeyPatch, folder: Path, group: str = "polarguide.recipes", **entries: str
) -> None:
    """Put a package's metadata, with entry points of a group, on the path for one test."""
    data = folder / f"{folder.name}-1.0.dist-info"
    data.mkdir(parents=True)
    (data / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {folder.name}\nVersion: 1.0\n")
    lines = "".join(f"{name} = {place}\n" for name, place in entries.items())
    (data / "entry_points.txt").write_text(f"[{group}]\n{lines}")
    monkeypatch.syspath_prepend(folder)
