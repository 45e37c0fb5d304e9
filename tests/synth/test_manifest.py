"""Checksums of a rendered scene that somebody else made."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from polarguide.core.errors import PolarguideError
from polarguide.synth.folder import MANIFEST, folder_state, verify_scene


def scene(root: Path, listed: bytes = b"") -> Path:
    root.mkdir()
    (root / MANIFEST).write_bytes(listed)
    (root / "scene.json").write_text(json.dumps({"sha256": hashlib.sha256(listed).hexdigest()}))
    return root


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (lambda root: (root / "scene.json").write_text("[]"), r"scene\.json: expected a JSON object"),
        (lambda root: (root / "scene.json").write_bytes(b"\xff"), r"scene\.json: expected a JSON file"),
        (lambda root: (root / "scene.json").unlink(), r"scene\.json: expected a readable file"),
        (lambda root: (root / MANIFEST).unlink(), "checksums.txt: expected a readable file"),
        (lambda root: ((root / MANIFEST).unlink(), os.mkfifo(root / MANIFEST)), "found a pipe or device"),
    ],
)
def test_files_that_are_none(tmp_path: Path, spoil: Callable[[Path], object], found: str) -> None:
    root = scene(tmp_path / "scene")
    verify_scene(root)
    spoil(root)
    with pytest.raises(PolarguideError, match=found):
        verify_scene(root)


@pytest.mark.parametrize("listed", [b"word\n", b"\xff\xfe\x00 x\n", b"0  \n"])
def test_lists_that_are_none(tmp_path: Path, listed: bytes) -> None:
    with pytest.raises(PolarguideError, match=r"expected the file that checksums\.txt lists"):
        verify_scene(scene(tmp_path / "scene", listed))


def test_no_file_outside_the_scene_is_read(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("mine")
    listed = f"{hashlib.sha256(b'mine').hexdigest()}  ../victim\n".encode()
    with pytest.raises(PolarguideError, match="a list of files of this scene"):
        verify_scene(scene(tmp_path / "scene", listed))


def test_a_request_that_says_nothing_more(tmp_path: Path) -> None:
    (tmp_path / "request.json").write_text('{"scene": {}, "settings": {}, "more": null}')
    with pytest.raises(PolarguideError, match=r"more: null in place of"):
        folder_state(tmp_path, {"scene": {}, "settings": {}})
